"""After the last frame: final poses, masks that look both ways, the static cloud, what a map is made from."""
