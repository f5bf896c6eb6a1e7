"""The specular lobe as four round ones: towards grazing views it is long and thin, which one round lobe is not.

A lobe that is seen head-on is round, and an environment is blurred with such lobes beforehand
(`beam_warp.kernels.light.prefilter`). Of a surface of roughness r that is seen by the cosine c, the lobe is the sum of
four of them along the plane of incidence: with x = sqrt(c), and the mirror direction m and the unit vector a at right
angles to it, lobe k has the

    direction m + r^2 sqrt(1 - c^2) o_k a, roughness r q_k and weight w_k / sum w, w_k = exp(l_k), l_3 = 0,

where o_k, q_k and l_k are polynomials of second degree in x and in r. They are fitted to the lobe D G F and its mean
direction, not to lights (`benchmarks/specular_lobe.py`). docs/rendering.md states what is left, and what one round lobe
leaves.

Sources of what they are fitted to: Walter et al. 2007 (GGX), Heitz 2014 (masking), Schlick 1994 (Fresnel).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LOBES = 4

LEAST_COSINE = wp.constant(0.01)
"""Smallest cosine that was fitted; below it the lobes are those at it."""

COEFFICIENTS = (
    (-0.1876, 2.3625, -3.7977, -1.7099, 2.4505, 5.3627, -4.0792, 1.9408, -3.9639),
    (0.311, 0.7843, -1.2121, -0.8633, 1.4773, 0.8768, -1.7236, -0.0937, -0.6648),
    (0.8287, 1.7877, -2.3684, -1.6635, 1.0332, 0.6681, 0.7452, -1.0718, -0.2163),
    (1.5144, 4.402, 3.657, -3.0614, -2.314, -7.5969, 4.0117, -1.2263, 1.9955),
    (0.2836, -0.7051, 0.7497, 0.6519, -0.7085, -0.0951, 0.62, 0.4972, -1.242),
    (0.2135, 0.0901, 0.0198, 0.3116, -0.33, 0.4068, 0.6197, -0.403, -0.4233),
    (0.2706, 0.3748, 0.0342, 0.0456, -0.0849, -0.8569, 0.6699, -0.4658, 1.2509),
    (0.5186, -0.6768, 2.9018, -0.1431, 1.4843, -4.4539, 0.4773, 1.1776, 0.4673),
    (-1.1821, -8.9746, 1.6353, 7.7178, 24.4479, -19.8497, -11.4382, 2.7746, -5.9217),
    (-2.2784, 3.2477, -3.0005, 5.2823, 1.8989, -1.647, -2.1948, -10.5176, 4.9053),
    (-0.9109, 6.429, -4.9052, -1.5132, -4.6117, -1.3976, 3.8924, -2.2867, 4.4409),
)
"""Rows: o_0 to o_3, q_0 to q_3, l_0 to l_2. Columns: of 1, r, r^2, x, x r, x r^2, x^2, x^2 r, x^2 r^2."""

vec9 = wp.types.vector(9, dtype=float)

POLYNOMIALS = wp.constant(wp.types.matrix((11, 9), dtype=float)([number for row in COEFFICIENTS for number in row]))


@wp.struct
class RoundLobes:
    """Four round lobes that make up a stretched one."""

    offsets: wp.vec4  # from the mirror direction in the plane of incidence, over the sine of the view's angle
    roughness: wp.vec4
    weights: wp.vec4  # their sum is 1


@wp.func
def round_lobes(cosine: float, roughness: float) -> RoundLobes:
    """What the specular lobe of a roughness is made of under the cosine n.v."""
    x = wp.sqrt(wp.max(cosine, LEAST_COSINE))
    r = roughness
    numbers = POLYNOMIALS * vec9(1.0, r, r * r, x, x * r, x * r * r, x * x, x * x * r, x * x * r * r)
    lobes = RoundLobes()
    total = float(0.0)
    for k in range(4):
        weight = float(1.0)
        if k < 3:
            weight = wp.exp(numbers[8 + k])
        lobes.offsets[k] = numbers[k] * r * r
        lobes.roughness[k] = wp.clamp(numbers[4 + k] * r, 0.0, 1.0)
        lobes.weights[k] = weight
        total += weight
    lobes.weights = lobes.weights / total
    return lobes
