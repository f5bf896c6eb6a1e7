"""Measurement of an asset against rules of physics: its materials in a white furnace, and its geometry traced afresh.

A random part of the Gaussians of the first, the middle and the last frame is traced. The same seed on the same device
measures the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_count
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidOptionError
from beam_warp.evaluate import physical_rules as rules
from beam_warp.evaluate.certificate import measured_again
from beam_warp.evaluate.physical_rules import LEAST_OPACITY, Measured
from beam_warp.evaluate.steadiness import RunningVariance
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.light.ggx import TABLE_SIZE, specular_albedo
from beam_warp.materials.normals import FLAT_RATIO
from beam_warp.schema.authoring import KERNEL_EXTENT
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.rays import ray_offsets
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence, Observability
from beam_warp.world.quaternions import rotation_matrices

SAMPLE_COUNT = 4096
"""Gaussians that are traced in a frame: a share of 1/16 is then known to 0.4 %."""

RAY_COUNT = 256
"""Rays of each hemisphere; the standard error of a visibility is then at most 0.03."""

MOST_FRAMES = 16
"""Frames, evenly over the sequence, over which materials are compared."""

STREAM = 0x9E3779B9
"""Added to the seed, so that random numbers are not those of ``beam run``."""

LEAST_CONFIDENCE = 0.5
"""Confidence below which a normal is not judged."""

NOT_MEASURED = Observability.UNSEEN | Observability.FILLED
NOT_CERTAIN = NOT_MEASURED | Observability.UNCERTAIN_NORMAL


def measure_physics(
    sequence: GaussianSequence,
    *,
    device: str | None = None,
    seed: int = 0,
    original: GaussianSequence | None = None,
    environments: Sequence[EnvironmentMap] = (),
    progress: StageProgress = no_progress,
) -> list[Measured]:
    """Measure an asset against all rules of physics.

    Args:
        sequence: Relightable, in metres, any axes.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        seed: Same seed, same device, same numbers.
        original: What a reduced asset was made from, so that its certificate can be measured again.
        environments: The lights of that certificate.
        progress: Called with (stage, done, total).

    Returns:
        What was measured about each rule, in the order of `beam_warp.evaluate.physical_rules.PHYSICAL_RULES`: of the
        frame that is nearest to the bound, or furthest beyond.

    Raises:
        InvalidOptionError: The asset is not relightable, the seed is out of range, or the original is another one.
        DeviceError: There is no such device.
    """
    require_count("seed", seed, 0, 2**32 - 1)
    if not sequence[0].is_relightable:
        raise InvalidOptionError(
            "asset must be relightable for physical checks, got one without all materials. Decompose it first."
        )
    last = len(sequence) - 1
    frames = sorted({0, last // 2, last})
    worst: dict[str, Measured] = {}
    for done, frame in enumerate(frames):
        progress("trace frames afresh", done, len(frames))
        for measured in measure_cloud(sequence[frame], device=device, seed=seed, frame=frame):
            before = worst.get(measured.rule)
            if before is None or _margin(measured) < _margin(before):
                worst[measured.rule] = measured
    worst[rules.STEADY.id] = steadiness(sequence)
    progress("measure the certificate again", 0, 1)
    worst[rules.CERTIFIED.id] = measured_again(sequence, original, environments, device=device)
    return [worst[rule.id] for rule in rules.PHYSICAL_RULES]


def measure_cloud(cloud: GaussianCloud, *, device: str | None = None, seed: int = 0, frame: int = 0) -> list[Measured]:
    """Measure one relightable frame against the rules that need no other frame; see `measure_physics`."""
    assert cloud.base_color is not None
    assert cloud.roughness is not None
    assert cloud.ambient_occlusion is not None
    assert cloud.normals is not None
    flags = np.zeros(len(cloud), np.uint8) if cloud.observability is None else cloud.observability
    confidence = np.ones(len(cloud)) if cloud.normal_confidence is None else cloud.normal_confidence
    solid = cloud.opacities >= LEAST_OPACITY
    seen, certain = solid & (flags & NOT_MEASURED == 0), solid & (flags & NOT_CERTAIN == 0)
    certain &= confidence >= LEAST_CONFIDENCE
    scene = Scene.from_gaussians(cloud, device)
    rng = np.random.default_rng((seed, frame))
    measured = [rules.furnace(furnace_albedo(cloud.base_color[solid], cloud.roughness[solid]))]
    # Another stream than that of the asset's own ambient occlusion, which would repeat its errors.
    stream = ((seed + STREAM) % 2**32, frame)

    rows = _some(rng, seen)
    # All of a kernel is below this height, the place among it included at which views saw the surface.
    reaches = KERNEL_EXTENT * cloud.scales[rows].max(axis=1)
    fresh, errors = _visibility(scene, cloud, rows, stream, lifts=(np.zeros(len(rows)), reaches))
    stated = np.zeros(len(cloud)) if cloud.ambient_occlusion_error is None else cloud.ambient_occlusion_error
    measured.append(rules.occlusion(cloud.ambient_occlusion[rows], stated[rows], fresh, errors))

    rows = _some(rng, certain)
    (out,), (out_error,) = _visibility(scene, cloud, rows, stream)
    (back,), (back_error,) = _visibility(scene, cloud.with_arrays(normals=-cloud.normals), rows, stream)
    measured.append(rules.facing(out, out_error, back, back_error))

    ordered = np.sort(cloud.scales, axis=1)
    flat = np.flatnonzero(certain & (ordered[:, 0] < FLAT_RATIO * ordered[:, 1]))
    axes = rotation_matrices(cloud.orientations[flat])
    thin = np.take_along_axis(axes, np.argmin(cloud.scales[flat], axis=1)[:, None, None], axis=2)[..., 0]
    measured.append(rules.shape(np.einsum("nk,nk->n", thin, cloud.normals[flat])))

    errors = np.zeros((len(cloud), 3)) if cloud.base_color_error is None else cloud.base_color_error
    measured.append(rules.color(cloud.base_color[seen], errors[seen]))
    return [Measured(**{**vars(each), "frame": frame}) for each in measured]


def furnace_albedo(base_color: NDArray[np.floating], roughness: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the share of uniform light that dielectrics reflect, in the brightest component, ``(N,)``.

    The diffuse part takes what the lobe leaves: (1 - E) base colour + E, with E the lobe's albedo, the cosine-weighted
    mean over all directions.
    """
    nodes = (np.arange(TABLE_SIZE) + 0.5) / TABLE_SIZE  # the cosine is the node's square
    lobe = specular_albedo(np.broadcast_to(nodes**2, (len(roughness), TABLE_SIZE)), np.asarray(roughness)[:, None])
    albedo = np.average(lobe, axis=1, weights=nodes**3)
    return (1.0 - albedo) * np.asarray(base_color, np.float64).max(axis=1) + albedo


def steadiness(sequence: GaussianSequence) -> Measured:
    """Measure how much base colour and roughness of each Gaussian vary over time, against their standard errors."""
    first = sequence[0]
    errors = [first.base_color_error, None if first.roughness_error is None else first.roughness_error[:, None]]
    if len(sequence) < 2 or sequence.topology != "constant":
        return Measured.absent(rules.STEADY, "no Gaussian is in two frames")
    if errors[0] is None:
        return Measured.absent(rules.STEADY, "no error of the base colour is stated")
    frames = np.unique(np.linspace(0, len(sequence) - 1, MOST_FRAMES).round().astype(int))
    stated, columns = np.concatenate([each for each in errors if each is not None], axis=1), 3 + (errors[1] is not None)
    running = [RunningVariance(len(first), 1) for _ in range(columns)]
    for frame in frames.tolist():
        for column, values in zip(running, _materials(sequence[frame]), strict=False):
            column.add(frame, values[:, None])
    variance = np.stack([np.square(column.deviations()) for column in running], axis=1)
    solid = first.opacities >= LEAST_OPACITY
    return rules.steady(variance[solid] * len(frames) / (len(frames) - 1), stated[solid])


def _materials(cloud: GaussianCloud) -> Iterable[NDArray[np.float32]]:
    """Yield the components of base colour, and roughness."""
    assert cloud.base_color is not None
    assert cloud.roughness is not None
    yield from cloud.base_color.T
    yield cloud.roughness


def _some(rng: np.random.Generator, judged: NDArray[np.bool_]) -> NDArray[np.int64]:
    rows = np.flatnonzero(judged)
    return rows if len(rows) <= SAMPLE_COUNT else np.sort(rng.choice(rows, SAMPLE_COUNT, replace=False))


def _visibility(
    scene: Scene,
    cloud: GaussianCloud,
    rows: NDArray[np.int64],
    stream: tuple[int, int],
    lifts: Sequence[NDArray[np.floating]] = (np.zeros(1),),
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Trace the hemispheres about some normals; return visibilities and standard errors, ``(lifts, rows)`` each.

    Rays start off the local surface, and above it by each of the ``lifts`` [m].
    """
    assert cloud.normals is not None
    points, normals = (upload(array[rows], wp.vec3, scene.device) for array in (cloud.positions, cloud.normals))
    surface = ray_offsets(scene, points, normals, "auto").numpy()
    found = []
    for number, lift in enumerate(lifts):
        offset = upload((surface + lift).astype(np.float32), float, scene.device)
        seed, frame = (stream[0] + number) % 2**32, stream[1]
        traced = ambient_occlusion(
            scene, points, normals, sample_count=RAY_COUNT, offset=offset, seed=seed, frame=frame
        )
        found.append((traced.visibility.numpy(), traced.standard_error.numpy()))
    values, errors = (np.stack(each) for each in zip(*found, strict=True))
    return values, errors


def _margin(measured: Measured) -> float:
    """Return how far a measurement is from its bound, negative beyond it; infinite if there is none."""
    if measured.passed is None:
        return np.inf
    away = abs(measured.bound - measured.value)
    return away if measured.passed else -away
