"""Two-view pointmaps (paper III-A, first step) behind one protocol."""
