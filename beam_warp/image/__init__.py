"""Pictures: files, colour, tone, film, panels, and how far two images differ."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
