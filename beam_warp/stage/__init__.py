"""What is rendered over time: assets, meshes, lights and cameras on a stage, and where frames go."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
