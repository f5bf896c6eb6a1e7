"""What counts as a hit: the rules of a trace, and the test of one Gaussian against them."""

import warp as wp

from beam_warp.kernels.trace.gaussian import Gaussians, RayPeak


@wp.struct
class TraceSettings:
    """Rules of a trace; built by ``beam_warp.trace.transmittance.TraceOptions``."""

    bernoulli: int  # 1: a hit blocks the whole ray with probability alpha; 0: transmittances multiply
    entry_in_front: int  # 1: the ray must start outside the support; 0: its peak must lie in front
    cull: int  # 1: Gaussians whose normal points along the ray do not count
    stop: float  # traversal ends below this transmittance


@wp.func
def counts(
    gaussians: Gaussians, settings: TraceSettings, index: int, peak: RayPeak, direction: wp.vec3, t_max: float
) -> bool:
    """Whether a Gaussian acts on a ray. The peak lies before ``t_max`` and, by rule, it or the entry in front."""
    start = peak.t
    if settings.entry_in_front == 1:
        start -= wp.sqrt(peak.half_chord_squared)
    result = peak.alpha > 0.0 and start > 0.0 and peak.t < t_max
    if result and settings.cull == 1:
        result = wp.dot(gaussians.normals[index], direction) <= 0.0
    return result
