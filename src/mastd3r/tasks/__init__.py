"""Commands as tasks: many at once, in processes of this machine or on a cluster; a killed one costs only itself."""
