"""Rays through Gaussians: visibility, occlusion, irradiance, first surfaces, and their gradients."""
