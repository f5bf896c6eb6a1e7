"""Gaussians from images: a first frame fitted, and every other frame tracked from it."""
