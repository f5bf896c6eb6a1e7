"""Kernels that tests write around device functions, run from NumPy to NumPy."""

import numpy as np
import warp as wp

from beam_warp.device.arrays import upload


def upload_floats(array, device):
    return upload(np.float32(array), float, device)


def run_kernel(kernel, shape, inputs, types, device):
    """Return the outputs of a kernel, one array of ``shape`` for each type; (array, type) inputs are uploaded."""
    given = [upload(*i, device) if isinstance(i, tuple) else i for i in inputs]
    outputs = [wp.zeros(shape, dtype=kind, device=device) for kind in types]
    wp.launch(kernel, shape, inputs=given, outputs=outputs, device=device)
    return [output.numpy() for output in outputs]
