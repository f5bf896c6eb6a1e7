"""Multi-view captures: loaders, lenses, inspection, and how a report of one looks."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
