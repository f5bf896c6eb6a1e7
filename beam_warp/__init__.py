"""Relightable 4D Gaussian assets on NVIDIA Warp.

The names most programs need are here; every package has a face of its own (`beam_warp.raster`, `beam_warp.trace`, …).
``__init__.pyi`` beside each face is its table: names are resolved from it on first use, so that ``import beam_warp``
costs no Warp and no USD, and type checkers read the same lines.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
