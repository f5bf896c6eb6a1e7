"""Gaussians drawn from other frameworks: gsplat's arguments in, torch gradients out."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
