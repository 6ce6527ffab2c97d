"""Cameras: the pinhole with radial terms, OpenCV's lens, rectification, and the view that the map works with."""
