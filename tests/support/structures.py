"""Warp structures from NumPy arrays."""

import numpy as np
import warp as wp


def filled(structure, device, **fields):
    """A structure with these fields: arrays brought to the device in the type of their field, others as they are."""
    result = structure()
    for name, value in fields.items():
        if isinstance(value, np.ndarray):
            dtype = structure.vars[name].type.dtype
            kind = np.int32 if dtype is wp.int32 or dtype is int else np.float32
            value = wp.array(np.ascontiguousarray(value, kind), dtype=dtype, device=device)
        setattr(result, name, value)
    return result
