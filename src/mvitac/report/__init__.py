"""The report, contact sheets and the explorer."""
