"""The public datasets that ``mastd3r download`` brings: where they are, and getting them into place."""
