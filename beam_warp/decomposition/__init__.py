"""The main job: from captured Gaussians and a known light to a relightable asset, frame by frame and resumable."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
