"""Random lights, cameras and frames under which two assets are compared: one stated distribution, drawn by number.

A trial is a frame, a camera and a light. The camera sees all of the subject from an azimuth that is uniform and an
elevation between `LOWEST` and `HIGHEST`, uniform over the sphere. The light is, with even chances, an environment
alone, turned by a uniform angle, or that environment dimmed to `DIMMED` beside a lamp: the sun, or a small sphere that
is `NEAREST` to `FURTHEST` radii of the subject away, both anywhere above the horizon, with shadows. Environments are
exposed so that the white diffuser that gets most light has the radiance `BRIGHTEST_WHITE`; one that faces a lamp gets
`LAMP_WHITE` of it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from beam_warp.checks import require_count
from beam_warp.digests import array_digest
from beam_warp.errors import InvalidOptionError
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import DirectionalLight, Light, PointLight
from beam_warp.world.shot import Shot

LOWEST, HIGHEST = -20.0, 75.0
"""Elevations between which cameras are [degree]."""

DIMMED = 0.25
"""Share of an environment that is left beside a lamp."""

NEAREST, FURTHEST = 1.5, 4.0
"""Distances of lamps from the middle of the subject, in its radii."""

BRIGHTEST_WHITE, LAMP_WHITE = 1.1, 0.8
"""Radiance of a white diffuser: the brightest one under an environment, and one that faces a lamp."""

MOST_ENVIRONMENTS, MOST_ROWS = 4, 128
"""Environments of a distribution, and rows that they are reduced to."""

Half = Literal["search", "certificate"]
"""Two streams of trials that share no draw."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One draw.

    Attributes:
        frame: Number of the frame.
        azimuth: Of the camera [degree].
        elevation: Of the camera [degree].
        environment: Number of the environment.
        turn: How far it is turned about z [degree].
        lamp: ``sun``, ``sphere`` or ``none``.
        toward: Unit direction to the lamp.
        distance: Distance of the sphere, in radii of the subject.
    """

    frame: int
    azimuth: float
    elevation: float
    environment: int
    turn: float
    lamp: str
    toward: tuple[float, float, float]
    distance: float


class RelitTrials:
    """A distribution of trials.

    Attributes:
        prepared: Exposed environments on the device; then the same dimmed.
        height: Side of the square images [pixel].
        seed: Same seed, same trials.
    """

    def __init__(
        self, environments: Sequence[EnvironmentMap], *, height: int = 256, seed: int = 0, device: Any = None
    ) -> None:
        """Expose the environments.

        Args:
            environments: 1 to `MOST_ENVIRONMENTS`, each with light.
            height: Side of the square images [pixel].
            seed: See the class.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            InvalidOptionError: There are none or too many environments, one is black, or a number is out of range.
        """
        if not 1 <= len(environments) <= MOST_ENVIRONMENTS:
            raise InvalidOptionError(
                f"environment must be 1 to {MOST_ENVIRONMENTS} maps, got {len(environments)}. Choose some."
            )
        self.height = require_count("height", height, 16, 4096)
        self.seed = require_count("seed", seed, 0, 2**32 - 1)
        exposed = [PreparedEnvironment(_exposed(environment), device) for environment in environments]
        self.prepared = (*exposed, *(each.scaled(DIMMED) for each in exposed))
        self._outlined: tuple[GaussianCloud | None, NDArray[np.float64]] = (None, np.zeros((0, 3)))

    def describe(self) -> dict[str, object]:
        """Return the distribution as JSON-able facts; lights by their digests."""
        lights = self.prepared[: len(self.prepared) // 2]
        return {
            "environments": [array_digest(light.environment.radiance)[:16] for light in lights],
            "height": self.height,
            "seed": self.seed,
        }

    def draw(self, half: Half, numbers: range, frames: Sequence[int]) -> list[Trial]:
        """Return the trials of some numbers, over some frames."""
        return [self._trial(half, number, frames) for number in numbers]

    def _trial(self, half: Half, number: int, frames: Sequence[int]) -> Trial:
        rng = np.random.default_rng((self.seed, half == "certificate", number))
        low, high = np.sin(np.radians((LOWEST, HIGHEST)))
        around, up = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 1.0)
        flat = np.sqrt(1.0 - up * up)
        return Trial(
            frame=int(frames[int(rng.integers(len(frames)))]),
            azimuth=float(rng.uniform(0.0, 360.0)),
            elevation=float(np.degrees(np.arcsin(rng.uniform(low, high)))),
            environment=int(rng.integers(len(self.prepared) // 2)),
            turn=float(rng.uniform(0.0, 360.0)),
            lamp=("none", "none", "sun", "sphere")[int(rng.integers(4))],
            toward=(float(flat * np.cos(around)), float(flat * np.sin(around)), float(up)),
            distance=float(rng.uniform(NEAREST, FURTHEST)),
        )

    def camera(self, trial: Trial, cloud: GaussianCloud) -> Camera:
        """Return the camera of a trial; all of a cloud's bulk is in its image."""
        side, points = self.height, self._outline(cloud)
        return Camera.frame_points(points, azimuth=trial.azimuth, elevation=trial.elevation, width=side, height=side)

    def _outline(self, cloud: GaussianCloud) -> NDArray[np.float64]:
        """Return corners of the hull of a cloud's bulk, ``(M, 3)``; those of the last cloud are kept."""
        if cloud is not self._outlined[0]:
            points = bulk(cloud.positions, cloud.opacities)
            with contextlib.suppress(QhullError):  # points on a line or a plane have no hull
                points = points[ConvexHull(points).vertices]
            self._outlined = cloud, points
        return self._outlined[1]

    def lights(self, trial: Trial, cloud: GaussianCloud) -> tuple[EnvironmentMap, tuple[Light, ...]]:
        """Return the environment of a trial, not yet turned, and the lamp beside it."""
        if trial.lamp == "none":
            return self.prepared[trial.environment].environment, ()
        dim = self.prepared[trial.environment + len(self.prepared) // 2].environment
        power = LAMP_WHITE * np.pi
        x, y, z = trial.toward
        if trial.lamp == "sun":
            return dim, (DirectionalLight(direction=(-x, -y, -z), irradiance=(power, power, power)),)
        points = self._outline(cloud)
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = max(float(np.linalg.norm(points - center, axis=1).max()), 1e-3)
        away = trial.distance * radius
        intensity, place = power * away * away, center + away * np.asarray(trial.toward)
        sphere = PointLight(
            position=(float(place[0]), float(place[1]), float(place[2])),
            intensity=(intensity, intensity, intensity),
            radius=0.05 * radius,
        )
        return dim, (sphere,)

    def shot(self, trial: Trial, cloud: GaussianCloud, framed: GaussianCloud) -> Shot:
        """Return the shot of a cloud; camera and lamp stand as for ``framed``, which it is judged by."""
        environment, lights = self.lights(trial, framed)
        return Shot(
            cloud=cloud,
            camera=self.camera(trial, framed),
            environment=environment,
            environment_rotation=trial.turn,
            lights=lights,
        )


def _exposed(environment: EnvironmentMap) -> EnvironmentMap:
    """Return an environment of at most `MOST_ROWS` rows, exposed."""
    if environment.height > MOST_ROWS:
        environment = environment.resized(MOST_ROWS, 2 * MOST_ROWS)
    brightest = float(environment.default_irradiance.max())  # which the scaled map keeps, for shading
    if not brightest > 0.0:
        raise InvalidOptionError("environment must have light, got a black one. Choose another map.")
    return environment.scaled(BRIGHTEST_WHITE * np.pi / brightest)
