"""What frozen features are worth: probes, controls, intervals."""
