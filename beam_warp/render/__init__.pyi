from .deferred import DeferredRenderer as DeferredRenderer
from .options import DeferredOptions as DeferredOptions
from .path import PathOptions as PathOptions
from .path import PathRenderer as PathRenderer
