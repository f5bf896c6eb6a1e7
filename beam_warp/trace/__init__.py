"""Rays through Gaussians: visibility, occlusion, irradiance, first surfaces, and their gradients."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
