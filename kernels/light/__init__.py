"""Light and reflection: environments, lamps, the BRDF, and directions drawn by them."""
