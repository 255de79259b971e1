"""Network parts: trunks, momentum copies, memory banks, losses."""
