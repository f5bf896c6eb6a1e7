"""Joints: their selection, the graph of neighbours, rigidity, and the skinning of Gaussians that they carry."""
