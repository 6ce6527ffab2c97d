"""Cameras, rigid and similarity transforms, robust kernels: no SLAM knowledge."""
