"""Coarse-to-fine alignment of a frame to its keyframe (paper III-B)."""
