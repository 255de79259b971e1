"""Reports, pictures and the explorer."""
