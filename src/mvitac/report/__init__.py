"""The report and contact sheets."""
