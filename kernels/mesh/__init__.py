"""Triangles: rays that meet them, distances to them, and their fusion from depth images."""
