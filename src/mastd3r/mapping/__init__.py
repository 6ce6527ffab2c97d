"""The Gaussian map with dynamic suppression (paper III-C)."""
