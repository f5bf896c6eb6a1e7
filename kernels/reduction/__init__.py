"""Reduction: quadratic forms of relit images, and what a refit moves."""
