"""Malformed and hostile inputs of every kind, made from a seed, and what no command may do with them."""
