"""A run in the browser: splat, clouds, mesh, the camera's path, and the picture of every frame. Served by viser."""
