"""Decomposition: base colour, roughness, ambient occlusion and normals from images under known light."""
