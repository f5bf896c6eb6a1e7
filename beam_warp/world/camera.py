"""Pinhole cameras, and constructors that place them.

Camera axes are OpenCV's: x right, y down, z forward. Pixel (0, 0) is the top left one and its centre is at (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_count, require_finite, require_number
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.world.framing import bulk, orbit_directions, pose_looking_at, require_point, require_points

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes of OpenGL (y up, looking along -z) to those of OpenCV (y down, looking along z), and back."""

MAX_SIDE = 65_536
"""Largest image side [pixel]; a larger one is taken for a mistake."""

MAX_PIXELS = 2**28
"""Most pixels of one image, 16,384 x 16,384; a G-buffer of this size takes 12 GB."""

RIGID_TOLERANCE = 1e-4
"""Largest entry of |R^T R - I| accepted as a rotation: single-precision poses printed with six digits are within it."""

_LENGTHS = ("focal_x", "focal_y", "center_x", "center_y")


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        width: Image width [pixel].
        height: Image height [pixel].
        focal_x: Focal length along x [pixel].
        focal_y: Focal length along y [pixel].
        center_x: Principal point from the left edge of the image [pixel].
        center_y: Principal point from the top edge of the image [pixel].
        camera_to_world: Rigid pose, ``(4, 4)`` float64; its columns are right, down, forward and the position [m].

    Raises:
        InvalidOptionError: A size, focal length or principal point is not a number in range.
        InvalidArrayError: The pose is not a rigid motion.
    """

    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float
    center_y: float
    camera_to_world: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check every field once."""
        for name in ("width", "height"):
            object.__setattr__(self, name, require_count(name, getattr(self, name), 1, MAX_SIDE))
        if self.width * self.height > MAX_PIXELS:
            raise InvalidOptionError(
                f"width x height must be at most {MAX_PIXELS}, got {self.width} x {self.height}. Choose a smaller one."
            )
        for name in ("focal_x", "focal_y"):
            object.__setattr__(self, name, require_number(name, getattr(self, name), 1e-3, 1e9))
        for name in ("center_x", "center_y"):
            object.__setattr__(self, name, require_number(name, getattr(self, name), -1e9, 1e9))
        pose = require_array("camera_to_world", self.camera_to_world, (4, 4), np.float64).copy()
        require_finite("camera_to_world", pose)
        if not np.array_equal(pose[3], (0.0, 0.0, 0.0, 1.0)):
            raise InvalidArrayError(
                f"camera_to_world must end in the row 0 0 0 1, got {pose[3].tolist()}. Pass a rigid motion."
            )
        rotation = pose[:3, :3]
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
        if not (error <= RIGID_TOLERANCE and np.linalg.det(rotation) > 0.0):
            raise InvalidArrayError(
                f"camera_to_world must hold a rotation, got |R^T R - I| = {error:.3g} and determinant "
                f"{np.linalg.det(rotation):.3g}. Take out scale, shear and mirroring."
            )
        pose.flags.writeable = False
        object.__setattr__(self, "camera_to_world", pose)

    @property
    def world_to_camera(self) -> NDArray[np.float64]:
        """Inverse of the pose, ``(4, 4)`` float64."""
        return np.linalg.inv(self.camera_to_world).astype(np.float64)

    @property
    def position(self) -> NDArray[np.float64]:
        """Position of the camera in the world [m], ``(3,)`` float64."""
        return self.camera_to_world[:3, 3]

    @property
    def forward(self) -> NDArray[np.float64]:
        """Unit world direction of the optical axis, ``(3,)`` float64."""
        return self.camera_to_world[:3, 2]

    def supersampled(self, factor: int) -> Camera:
        """Return the camera with ``factor`` x ``factor`` pixels in place of each pixel.

        Raises:
            InvalidOptionError: ``factor`` is below 1, or the images would be too large.
        """
        require_count("factor", factor, 1, MAX_SIDE)
        return replace(
            self,
            width=self.width * factor,
            height=self.height * factor,
            **{name: getattr(self, name) * factor for name in _LENGTHS},
        )

    def reduced(self, factor: int) -> Camera:
        """Return the camera with one pixel in place of ``factor`` x ``factor`` pixels.

        Rows and columns beyond the last whole pixel are left out.

        Raises:
            InvalidOptionError: Nothing would be left.
        """
        require_count("factor", factor, 1, min(self.width, self.height))
        return replace(
            self,
            width=self.width // factor,
            height=self.height // factor,
            **{name: getattr(self, name) / factor for name in _LENGTHS},
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Return the camera that sees a part of the image, in whole pixels."""
        return replace(self, width=width, height=height, center_x=self.center_x - left, center_y=self.center_y - top)

    def directions(self) -> NDArray[np.float64]:
        """Return unit world directions from the camera through every pixel centre, ``(height, width, 3)`` float64."""
        x = (np.arange(self.width) + 0.5 - self.center_x) / self.focal_x
        y = (np.arange(self.height) + 0.5 - self.center_y) / self.focal_y
        rays = np.ones((self.height, self.width, 3))
        rays[..., 0], rays[..., 1] = x[None, :], y[:, None]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return rays @ self.camera_to_world[:3, :3].T

    def axis_cosines(self) -> NDArray[np.float64]:
        """Return the cosine of the angle between the optical axis and each pixel's direction, ``(height, width)``."""
        return self.directions() @ self.forward

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Project world points.

        Args:
            points: World positions [m], ``(N, 3)``.

        Returns:
            ``(N, 3)`` float64: pixel x, pixel y, and depth along the optical axis [m]. The pixel is NaN where the
            depth is not positive, since such a point is on no pixel.

        Raises:
            InvalidArrayError: ``points`` has another shape.
        """
        world = require_array("points", points, (None, 3), np.float64)
        local = (world - self.position) @ np.linalg.inv(self.camera_to_world[:3, :3]).T
        depth = np.where(local[:, 2] > 0.0, local[:, 2], np.nan)
        return np.stack(
            [
                self.focal_x * local[:, 0] / depth + self.center_x,
                self.focal_y * local[:, 1] / depth + self.center_y,
                local[:, 2],
            ],
            axis=-1,
        )

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        *,
        up: ArrayLike = (0.0, 0.0, 1.0),
        width: int,
        height: int,
        vertical_fov: float,
    ) -> Camera:
        """Place a camera at ``eye`` that looks at ``target``, with square pixels and a centred principal point.

        Args:
            eye: Position of the camera [m], ``(3,)``.
            target: Point that it looks at [m], ``(3,)``.
            up: World direction that points up in the image, ``(3,)``; not parallel to the viewing direction.
            width: Image width [pixel].
            height: Image height [pixel].
            vertical_fov: Angle between the top and bottom edges of the image [degree].

        Raises:
            InvalidArrayError: ``eye``, ``target`` or ``up`` is not three finite numbers.
            InvalidOptionError: They coincide or are parallel, or the angle or a size is out of range.
        """
        pose = pose_looking_at(eye, target, up)
        rows = require_count("height", height, 1, MAX_SIDE)
        columns = require_count("width", width, 1, MAX_SIDE)
        focal = focal_length(rows, vertical_fov)
        return cls(columns, rows, focal, focal, 0.5 * columns, 0.5 * rows, pose)

    @classmethod
    def orbit(
        cls,
        center: ArrayLike,
        distance: float,
        azimuth: float,
        elevation: float,
        *,
        width: int,
        height: int,
        vertical_fov: float,
    ) -> Camera:
        """Place a camera on a sphere around ``center``, looking at it.

        Args:
            center: Point that the camera looks at [m], ``(3,)``.
            distance: Distance from that point [m].
            azimuth: Angle around the vertical [degree]. At 0 the camera looks along +y, the world's forward; it grows
                counter-clockwise as seen from above, so that 90 sees the scene from +x.
            elevation: Angle above the horizon, -90 to 90 [degree]; at the poles, up continues along the meridian.
            width: Image width [pixel].
            height: Image height [pixel].
            vertical_fov: Angle between the top and bottom edges of the image [degree].

        Raises:
            InvalidArrayError: ``center`` is not three finite numbers.
            InvalidOptionError: The distance, an angle or a size is out of range.
        """
        middle = require_point("center", center)
        away, above = orbit_directions(azimuth, elevation)
        reach = require_number("distance", distance, 1e-6, 1e9)
        return cls.look_at(
            middle + reach * away, middle, up=above, width=width, height=height, vertical_fov=vertical_fov
        )

    @classmethod
    def frame_cloud(
        cls,
        positions: ArrayLike,
        opacities: ArrayLike | None = None,
        *,
        azimuth: float = 0.0,
        elevation: float = 0.0,
        width: int,
        height: int,
        vertical_fov: float = 35.0,
        margin: float = 1.1,
    ) -> Camera:
        """Place an orbit camera so near that a cloud just fills the image.

        Trained clouds have stray Gaussians far off, so only the positions that `bulk` returns are framed. All other
        arguments are those of `frame_points`.

        Args:
            positions: Centres [m], ``(N, 3)`` with N at least 1.
            opacities: Weight of each position, ``(N,)`` in [0, 1]; None weighs all the same.

        Raises:
            InvalidArrayError: An array breaks its contract, or there is no Gaussian.
            InvalidOptionError: An angle, the margin or a size is out of range.
        """
        return cls.frame_points(
            bulk(positions, opacities),
            azimuth=azimuth,
            elevation=elevation,
            width=width,
            height=height,
            vertical_fov=vertical_fov,
            margin=margin,
        )

    @classmethod
    def frame_points(
        cls,
        points: ArrayLike,
        *,
        azimuth: float = 0.0,
        elevation: float = 0.0,
        width: int,
        height: int,
        vertical_fov: float = 35.0,
        margin: float = 1.1,
    ) -> Camera:
        """Place an orbit camera so near that points just fill the image; all of them are inside.

        Args:
            points: World positions [m], ``(N, 3)`` with N at least 1.
            azimuth: See `orbit` [degree].
            elevation: See `orbit` [degree].
            width: Image width [pixel].
            height: Image height [pixel].
            vertical_fov: Angle between the top and bottom edges of the image [degree].
            margin: Size of the image over that of the part that the points may fill, at least 1.

        Raises:
            InvalidArrayError: ``points`` breaks its contract, or is empty.
            InvalidOptionError: An angle, the margin or a size is out of range.
        """
        kept = require_points("points", points)
        center = 0.5 * (kept.min(axis=0) + kept.max(axis=0))
        room = require_number("margin", margin, 1.0, 100.0)
        trial = cls.orbit(
            center, 1.0, azimuth, elevation, width=width, height=height, vertical_fov=vertical_fov
        )  # its rotation and focal length are final; only the distance is left to find
        offset = (kept - center) @ trial.camera_to_world[:3, :3]
        # A point at depth d + z is inside if |x| focal / (d + z) <= half the side / margin: solve for d.
        needed = np.maximum(
            np.abs(offset[:, 0]) * trial.focal_x * room / (0.5 * trial.width),
            np.abs(offset[:, 1]) * trial.focal_y * room / (0.5 * trial.height),
        )
        extent = float(np.linalg.norm(kept.max(axis=0) - kept.min(axis=0)))
        distance = max(float((needed - offset[:, 2]).max()), 1.05 * float(-offset[:, 2].min()), 1e-3 * extent)
        if not distance > 0.0:  # every point is the same: any distance frames it
            distance = 1.0
        return cls.orbit(center, distance, azimuth, elevation, width=width, height=height, vertical_fov=vertical_fov)


def focal_length(height: int, vertical_fov: float) -> float:
    """Return the focal length [pixel] at which ``height`` pixels span ``vertical_fov`` degrees."""
    angle = require_number("vertical_fov", vertical_fov, 0.01, 179.0)
    return 0.5 * height / float(np.tan(np.radians(0.5 * angle)))
