"""mastd3r-slam: trajectory, static map and clean splat from any video of a moving world."""

__version__ = "0.1.0"
