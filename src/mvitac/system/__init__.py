"""What the operating system gives: files, locks, processes, devices, memory, many machines."""
