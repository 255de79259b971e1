"""Files, locks, processes, devices, memory, distributed training."""
