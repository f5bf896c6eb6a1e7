"""Triangle meshes: fusion of depth images, files, topology, texture coordinates and distances."""
