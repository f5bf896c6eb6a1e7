"""Distant light as a lat-long map: reading, rotation, resizing, and integrals over the sphere.

The mapping, for a unit world direction d (z up): u = 0.5 - atan2(d.y, d.x) / 2π, v = acos(d.z) / π from the top row.
The centre of the image is +x, its left quarter +y. Radiance is constant inside a texel; all integrals here are of that
function. The device side of the mapping is `beam_warp.kernels.light.latlong`.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_count, require_number, require_path
from beam_warp.errors import AssetFormatError, BeamError, InvalidArrayError
from beam_warp.image.files import MAX_ENVIRONMENT_PIXELS, MAX_SIDE, read_image

if TYPE_CHECKING:
    import scipy.sparse

MIN_HEIGHT = 4
"""Fewest rows of a map: below, a texel spans more than an octant."""

DEFAULT_IRRADIANCE_SIZE = (64, 128)
"""Rows and columns of an irradiance map whose bilinear lookup has an error of 3e-4."""

IRRADIANCE_ROWS = 512
"""Rows of the grid behind `EnvironmentMap.irradiance_map`. Texels that straddle the horizon lose at most the fraction
δ² / 12 of uniform light, δ = π / rows: 3.2e-6."""


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Radiance that arrives from every direction.

    Attributes:
        radiance: Scene-linear Rec.709 [W/(m² sr)], finite, not negative, ``(H, 2 H, 3)`` float32, H at least 4.

    Raises:
        InvalidArrayError: The array breaks that contract.
    """

    radiance: NDArray[np.float32]

    def __post_init__(self) -> None:
        """Convert and check the map once."""
        array = require_array("radiance", self.radiance, (None, None, 3))
        _require_environment("radiance", array, "", InvalidArrayError)
        array = array.copy() if array is self.radiance else array
        array.flags.writeable = False
        object.__setattr__(self, "radiance", array)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> EnvironmentMap:
        """Read an .exr or .hdr file as scene-linear radiance; alpha is not looked at.

        Raises:
            MissingFileError: There is no such file.
            AssetFormatError: It is no image, no HDR format, not 2:1, larger than `MAX_ENVIRONMENT_PIXELS`, or a texel
                is negative, NaN or infinite.
        """
        path = require_path("path", path)
        if path.suffix.lower() not in (".exr", ".hdr"):
            raise AssetFormatError(
                f"environment must be an .exr or .hdr file, got {path}. A display-referred image lacks the range of "
                "light: export a high-dynamic-range one."
            )
        radiance = read_image(path, max_pixels=MAX_ENVIRONMENT_PIXELS).rgb()
        _require_environment("environment", radiance, f" in {path}", AssetFormatError)
        return cls(radiance)

    @classmethod
    def constant(cls, rgb: ArrayLike, *, height: int = 16) -> EnvironmentMap:
        """Return uniform light of one radiance ``(3,)``, for furnaces and plain previews."""
        color = require_array("rgb", rgb, (3,))
        require_count("height", height, MIN_HEIGHT, MAX_SIDE // 2)
        return cls(np.broadcast_to(color, (height, 2 * height, 3)))

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.radiance.shape[0]

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.radiance.shape[1]

    def directions(self) -> NDArray[np.float64]:
        """Return the unit direction of every texel centre, ``(H, W, 3)``."""
        return texel_directions(self.height, self.width)

    def solid_angles(self) -> NDArray[np.float64]:
        """Return the exact solid angle of every texel [sr], ``(H, W)``; they sum to 4π."""
        rows = (2.0 * np.pi / self.width) * -np.diff(np.cos(_row_edges(self.height)))
        return np.broadcast_to(rows[:, None], (self.height, self.width))

    def mean_radiance(self) -> NDArray[np.float64]:
        """Return the mean over the sphere, ``(3,)``: every texel weighted by its solid angle."""
        weights = self.solid_angles()[:, 0] / (4.0 * np.pi)
        return np.einsum("r,rcx->x", weights, self.radiance, dtype=np.float64)

    def scaled(self, factor: float) -> EnvironmentMap:
        """Return the light times a factor of at least 0."""
        gain = np.float32(require_number("factor", factor, 0.0, 3e38))
        with np.errstate(over="ignore"):  # infinity is refused by the record, in words
            result = EnvironmentMap(self.radiance * gain)
        if "default_irradiance" in self.__dict__:
            result.__dict__["default_irradiance"] = self.default_irradiance * gain
        return result

    def exposed(self, stops: float) -> EnvironmentMap:
        """Return the light times 2^stops."""
        return self.scaled(2.0 ** require_number("stops", stops, -64.0, 64.0))

    def rotated(self, degrees: float) -> EnvironmentMap:
        """Turn the light about +z: positive angles counter-clockwise as seen from above, so that +x goes to +y.

        Exact where the angle is a whole number of texels. Elsewhere each texel is shared between two neighbours of its
        row in proportion; a row's solid angles are equal, so that each row keeps its energy to rounding.
        """
        columns = require_number("degrees", degrees, -3.6e6, 3.6e6) / 360.0 * self.width
        whole = round(columns)
        if abs(columns - whole) <= 1e-9 * self.width:  # the angle itself carries rounding
            result = EnvironmentMap(np.roll(self.radiance, -whole, axis=1))
            steps = whole * DEFAULT_IRRADIANCE_SIZE[1] / self.width
            if "default_irradiance" in self.__dict__ and steps == int(steps):
                result.__dict__["default_irradiance"] = np.roll(self.default_irradiance, -int(steps), axis=1)
            return result
        whole = int(np.floor(columns))
        part = np.float32(columns - whole)
        near, far = np.roll(self.radiance, -whole, axis=1), np.roll(self.radiance, -whole - 1, axis=1)
        return EnvironmentMap((near * (1 - part) + far * part).astype(np.float32))

    def resized(self, height: int, width: int) -> EnvironmentMap:
        """Return the map on another 2:1 grid: each new texel is the mean over its solid angle, so energy is kept."""
        require_count("height", height, MIN_HEIGHT, MAX_SIDE // 2)
        require_count("width", width, 2 * MIN_HEIGHT, MAX_SIDE)
        rows = _overlap_means(-np.cos(_row_edges(self.height)), -np.cos(_row_edges(height)))
        columns = _overlap_means(np.linspace(0.0, 1.0, self.width + 1), np.linspace(0.0, 1.0, width + 1))
        by_rows = rows @ self.radiance.reshape(self.height, -1).astype(np.float64)
        by_columns = columns @ by_rows.reshape(height, self.width, 3).transpose(1, 0, 2).reshape(self.width, -1)
        return EnvironmentMap(by_columns.reshape(width, height, 3).transpose(1, 0, 2).astype(np.float32))

    @cached_property
    def default_irradiance(self) -> NDArray[np.float32]:
        """`irradiance_map` of the default size, computed once; scaling and rotation by whole columns keep it."""
        return self.irradiance_map(*DEFAULT_IRRADIANCE_SIZE)

    def irradiance_map(self, height: int = 64, width: int = 128) -> NDArray[np.float32]:
        """Return the irradiance E(n) = ∫ L(ω) max(0, n·ω) dω of every normal n of a lat-long grid.

        The map is first averaged to `IRRADIANCE_ROWS` rows. With the first moment M of each texel in closed form,
        E(n) = Σ L max(0, n·M): exact for every texel on one side of n's horizon. Along a row that sum is a circular
        correlation in azimuth, done by FFT, so that every texel counts for every normal at little cost.

        Args:
            height: Rows of the result.
            width: Columns of the result; irradiance is so smooth that 64 × 128 and bilinear lookup suffice.

        Returns:
            Irradiance [W/m²], unit radiance from everywhere giving π, ``(height, width, 3)`` float32.
        """
        require_count("height", height, MIN_HEIGHT, 1024)
        require_count("width", width, MIN_HEIGHT, 2048)
        stride = 2 * -(-IRRADIANCE_ROWS // width)  # an even number of source columns for each column of the result
        columns = stride * width
        source = self.resized(columns // 2, columns)
        spectrum = np.fft.rfft(source.radiance.astype(np.float64), axis=1)  # (rows, frequencies, channel)
        spectrum = np.ascontiguousarray(spectrum.transpose(1, 0, 2))  # frequency first: one small product each
        theta = _row_edges(source.height)
        # ∫∫ (cos φ sin θ, cos θ) sin θ dθ dφ over a texel whose middle is at φ = 0, for each row
        sideways = np.diff(theta / 2.0 - np.sin(2.0 * theta) / 4.0) * (2.0 * np.sin(np.pi / columns))
        upward = np.diff(np.sin(theta) ** 2 / 2.0) * (2.0 * np.pi / columns)
        # azimuth from a normal's column to each source column; the first normal lies (stride - 1) / 2 columns in
        cosine = np.cos((np.arange(columns) - (stride - 1) / 2.0) * (2.0 * np.pi / columns))
        result = np.empty((height, width, 3), np.float32)

        def fill(row: int) -> None:
            polar = (row + 0.5) * (np.pi / height)
            kernel = np.maximum(np.sin(polar) * sideways[:, None] * cosine + np.cos(polar) * upward[:, None], 0.0)
            weights = np.fft.rfft(kernel, axis=1).conj().T[:, None, :]
            # A normal mirrored at the equator weighs the mirrored rows alike: one transform serves both.
            for place, mirrored in ((row, weights), (height - 1 - row, weights[:, :, ::-1])):
                product = np.matmul(mirrored, spectrum)[:, 0]
                result[place] = np.fft.irfft(product, columns, axis=0)[::stride]

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(fill, range((height + 1) // 2)))
        return np.maximum(result, 0.0)  # a dark hemisphere is zero up to the rounding of the FFT


def texel_directions(height: int, width: int, rows: slice = slice(None)) -> NDArray[np.float64]:
    """Return the unit directions of the texel centres of a lat-long grid, or of some of its rows, ``(R, width, 3)``."""
    theta = (np.arange(height)[rows] + 0.5) * (np.pi / height)
    phi = np.pi - (np.arange(width) + 0.5) * (2.0 * np.pi / width)
    sine = np.sin(theta)[:, None]
    up = np.broadcast_to(np.cos(theta)[:, None], (len(theta), width))
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), up], axis=-1)


def _row_edges(height: int) -> NDArray[np.float64]:
    """Polar angles of the edges of the rows [rad]."""
    return np.linspace(0.0, np.pi, height + 1)


def _overlap_means(old_edges: NDArray[np.float64], new_edges: NDArray[np.float64]) -> scipy.sparse.csr_array:
    """Return the matrix that takes values per old interval to means per new interval; edges rise, ends agree."""
    import scipy.sparse  # it takes as long to load as a viewer to start

    edges = np.union1d(old_edges, new_edges)
    middle = 0.5 * (edges[1:] + edges[:-1])
    old = np.clip(np.searchsorted(old_edges, middle) - 1, 0, len(old_edges) - 2)
    new = np.clip(np.searchsorted(new_edges, middle) - 1, 0, len(new_edges) - 2)
    weights = np.diff(edges) / np.diff(new_edges)[new]
    return scipy.sparse.csr_array((weights, (new, old)), shape=(len(new_edges) - 1, len(old_edges) - 1))


def _require_environment(name: str, radiance: NDArray[np.float32], where: str, error: type[BeamError]) -> None:
    """Refuse a map that is not 2:1, finite and non-negative; the message names the first bad texel."""
    height, width = radiance.shape[:2]
    if height < MIN_HEIGHT or width != 2 * height:
        raise error(
            f"{name} must be a lat-long map twice as wide as high and at least {MIN_HEIGHT} px high, got "
            f"{width} x {height}{where}. Convert cube maps, angular maps and crops to the full lat-long map."
        )
    good = np.isfinite(radiance) & (radiance >= 0.0)
    if not good.all():
        bad = ~good.all(axis=-1)
        row, column = np.argwhere(bad)[0]
        raise error(
            f"{name} must be finite and not negative, got {radiance[row, column].tolist()} at row {row}, column "
            f"{column} ({bad.sum()} texels in all){where}. Mend those texels."
        )
