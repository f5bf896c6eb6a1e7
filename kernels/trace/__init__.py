"""Rays through Gaussians: the hierarchy, its traversal, and estimators on top of it."""
