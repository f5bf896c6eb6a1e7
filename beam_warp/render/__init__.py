"""Renderers: deferred shading in real time, path tracing offline, and pictures of channels."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
