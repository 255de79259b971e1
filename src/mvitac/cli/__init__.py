"""The commands, a module per family. Each imports what it needs only when it is called (``main.COMMANDS`` names them)."""
