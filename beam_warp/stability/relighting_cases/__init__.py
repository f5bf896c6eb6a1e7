"""Subjects and lights on which relighting fails: small shots, and what must hold of their images.

What must hold is a closed form, many samples of a path tracer, or a bound; each with the reason for how far an image
may be off, derived and not fitted to what renderers give. Each family of cases is a module; a case is a function under
`stability_case`.
"""

from beam_warp.stability.relighting_cases import catchers, energy, gaussians, inputs, shadows
from beam_warp.stability.relighting_cases.cases import RelightStress
from beam_warp.stability.suite import StabilityCase

FAMILIES = (shadows, energy, gaussians, catchers, inputs)

RELIGHTING_CASES: list[StabilityCase[RelightStress]] = [
    case for family in FAMILIES for case in vars(family).values() if isinstance(case, StabilityCase)
]
"""Every case, family by family."""
