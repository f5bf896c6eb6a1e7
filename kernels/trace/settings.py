"""What counts as a hit: the rules of a trace."""

import warp as wp


@wp.struct
class TraceSettings:
    """Rules of a trace; built by ``beam_warp.trace.transmittance.TraceOptions``."""

    bernoulli: int  # 1: a hit blocks the whole ray with probability alpha; 0: transmittances multiply
    entry_in_front: int  # 1: the ray must start outside the support; 0: its peak must lie in front
    cull: int  # 1: Gaussians whose normal points along the ray do not count
    stop: float  # traversal ends below this transmittance
