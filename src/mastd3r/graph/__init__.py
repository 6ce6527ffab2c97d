"""Keyframes, their poses, and the joint optimisation."""
