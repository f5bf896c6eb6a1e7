"""Gaussians drawn as images: any channel, depth and normals, with gradients."""
