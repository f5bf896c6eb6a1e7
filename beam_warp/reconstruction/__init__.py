"""Gaussians from images: a first frame fitted, and every other frame tracked from it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
