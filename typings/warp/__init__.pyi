# Warp builds its types at run time and its own annotations refuse its idioms (vec3 as a dtype, struct as a class):
# to the type checker it is untyped.
from typing import Any

def __getattr__(name: str) -> Any: ...
