"""Triangle meshes: fusion of depth images, files, topology, texture coordinates and distances."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
