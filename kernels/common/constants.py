"""Pi, and the cut-offs that tracer and rasteriser share, each with its derivation or source."""

import warp as wp

PI = wp.constant(3.14159265358979323846)

ALPHA_MAX = wp.constant(0.99)
"""Cap of one Gaussian's alpha (Kerbl et al. 2023): 1 - alpha stays >= 0.01, so dividing it out stays stable, and what
is behind an opaque one keeps a gradient."""

ALPHA_MIN = wp.constant(1.0 / 255.0)
"""Smallest alpha that counts (Kerbl et al. 2023): below one step of an 8-bit image."""

TRANSMITTANCE_STOP = wp.constant(1.0e-4)
"""A ray or a pixel is done below this transmittance (BEAM §3.2): the largest error that stopping causes. The Gaussian
that gets it there still counts: leaving it out, as 3DGS does, can drop 1 % of a pixel."""

DIRECTION_FLOOR = wp.constant(1.0e-12)
"""Smallest |component| of a direction in a box test: 0 * inf is NaN and loses the hit when the origin is on a slab."""

LARGEST_FLOAT = wp.constant(3.0e38)
"""Stands for infinity in comparisons that may run under fast-math."""
