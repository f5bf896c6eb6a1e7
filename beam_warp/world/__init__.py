"""Records of what is in the world: Gaussians, cameras, lights, environments and shots, in NumPy."""
