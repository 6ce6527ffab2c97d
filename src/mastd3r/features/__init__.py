"""Sparse features, for jumps that dense flow cannot follow."""
