"""Options of the main job."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from beam_warp.checks import require_count, require_number
from beam_warp.errors import InvalidOptionError
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.roughness_source import RoughnessTexture
from beam_warp.world.camera import MAX_SIDE

if TYPE_CHECKING:
    from beam_warp.materials.images import ImagePathOptions
    from beam_warp.render.sheet import Relighting

ESTIMATE = "estimate"


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of `beam_warp.run`.

    Attributes:
        materials: Rays, offset, bounce, seed of the direct path; None takes its defaults. The image path has none.
        images: Options of the image path, the paper's, which is then taken; None takes the direct path.
        roughness: Perceptual roughness of everything, a texture, or ``"estimate"``: found from the specular residue
            over views and frames.
        exposure: Stops by which the environment is brightened before use; ``"auto"`` finds them where the captured
            colour is display-referred, whose scale is unknown, and takes 0 where it is scene-linear. With a capture,
            its images decide, because they are what is explained; a light that comes with it is changed only as far as
            base colours would be impossible otherwise.
        turn_light: Turn the light about the up axis where the capture shows beyond doubt that it is a little askew.
            Only a light that comes with the capture is turned; see `beam_warp.materials.light_turn`.
        persistent: State that row i is the same Gaussian in every frame, so that base colour is fitted over all
            frames at once; sequences that carry ids state it themselves.
        device: Warp device; None takes the first CUDA device, or the CPU.

    Raises:
        InvalidOptionError: The exposure or the roughness is out of range, or both paths have options.
    """

    materials: MaterialOptions | None = None
    images: ImagePathOptions | None = None
    roughness: float | RoughnessTexture | Literal["estimate"] = 0.5
    exposure: float | Literal["auto"] = "auto"
    turn_light: bool = True
    persistent: bool = False
    device: str | None = None

    def __post_init__(self) -> None:
        """Check each option, and that one path alone has options, which check themselves."""
        if self.materials is not None and self.images is not None:
            default = asdict(MaterialOptions())
            stated = [f"{key} {value}" for key, value in asdict(self.materials).items() if value != default[key]]
            raise InvalidOptionError(
                "materials (sample_count, offset, bounce and so on) must be left out on the image path, which has "
                f"options of its own, got {', '.join(stated) or 'defaults'}. Drop them, or take the direct path."
            )
        if not isinstance(self.roughness, RoughnessTexture) and self.roughness != ESTIMATE:
            require_number("roughness", self.roughness, 0.0, 1.0)
        if self.exposure != "auto":
            require_number("exposure", self.exposure, -32.0, 32.0)

    @property
    def roughness_source(self) -> str:
        """The asset's word for where roughness comes from."""
        if isinstance(self.roughness, RoughnessTexture):
            return "texture"
        return "estimated" if self.roughness == ESTIMATE else "constant"

    @property
    def shared_roughness(self) -> frozenset[str]:
        """Names of the arrays of roughness that persistent Gaussians have in common."""
        return frozenset({"roughness", "roughness_error"} if self.roughness == ESTIMATE else {"roughness"})

    @property
    def gathering(self) -> MaterialOptions:
        """How light is gathered at points: `materials`, or on the image path, where estimates need it, its defaults."""
        return self.materials or MaterialOptions(seed=0 if self.images is None else self.images.seed)

    def as_dict(self) -> dict[str, Any]:
        """Return the options of the path that is taken as JSON-able values.

        The device is left out, because reports state it by its name.
        """
        described = asdict(self)
        described.pop("device")
        described.pop("images" if self.images is None else "materials")
        if self.images is None:
            described["materials"] = asdict(self.gathering)
        if isinstance(self.roughness, RoughnessTexture):
            described["roughness"] = {key: str(value) for key, value in described["roughness"].items()}
        return described


@dataclass(frozen=True, kw_only=True)
class OverviewOptions:
    """Options of the contact sheet.

    Attributes:
        second_light: Shown beside the light that was given; that light turned by 180 degrees if None.
        azimuth: Camera angle; 0 looks along +y [degree].
        elevation: Camera angle above the horizon [degree].
        height: Height of a panel [pixel].

    Raises:
        InvalidOptionError: A number is out of range.
    """

    second_light: Relighting | None = None
    azimuth: float = 0.0
    elevation: float = 5.0
    height: int = 640

    def __post_init__(self) -> None:
        """Check the numbers before hours of work end in a picture that cannot be drawn."""
        require_number("azimuth", self.azimuth, -3600.0, 3600.0)
        require_number("elevation", self.elevation, -90.0, 90.0)
        require_count("height", self.height, 1, MAX_SIDE)
