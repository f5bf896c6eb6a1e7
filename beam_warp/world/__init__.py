"""Records of what is in the world: Gaussians, cameras, lights, environments and shots, in NumPy."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
