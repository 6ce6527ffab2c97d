"""Trajectory, image and mask errors against truth."""
