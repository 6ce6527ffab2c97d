"""What moves and what does not (paper III-A)."""
