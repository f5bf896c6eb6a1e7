"""Decomposition: evidence of views, residues, baking, and roughness."""
