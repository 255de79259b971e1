"""Simulated visual-tactile data: reliefs, gel optics, materials and grasps (numpy, scipy and MuJoCo)."""
