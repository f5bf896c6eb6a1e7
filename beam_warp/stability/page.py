"""The page of the stability suite: the outcome of every case on every device, side by side."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from operator import attrgetter
from pathlib import Path
from typing import Any

from beam_warp._version import __version__
from beam_warp.capture.images import EXPOSURE_STOPS as INSPECTED_STOPS
from beam_warp.digests import code_digest
from beam_warp.errors import AssetFormatError, MissingFileError
from beam_warp.image.files import replacing
from beam_warp.jobs.markdown import markdown_table
from beam_warp.reconstruction.gains import EXPOSURE_STOPS
from beam_warp.stability import captures, materials, relighting
from beam_warp.stability.analytic_occlusion import SHAPES, OcclusionOutcome
from beam_warp.stability.capture_cases import CAPTURE_CASES
from beam_warp.stability.captures import CaptureOutcome
from beam_warp.stability.material_cases import MATERIAL_CASES
from beam_warp.stability.materials import MaterialOutcome
from beam_warp.stability.relighting import RelightingOutcome
from beam_warp.stability.relighting_cases import RELIGHTING_CASES
from beam_warp.stability.suite import CaseOutcome, OutcomeRecord, StabilityCase
from beam_warp.stability.tracing import TracingOutcome
from beam_warp.stability.tracing_cases import CASES

HOW_TO_READ = """\
Scenes on which ray tracers lose hits, return NaN or never return, and what this one makes of them. The numbers are
those of one run of

    {command}

Each case runs under the tree in both builds and under one that was built for other places and refitted; the table has
the worst of them. Each device has a column: run with `--json` there, and give those files to `--beside` of the run that
writes the page.

**Error** is the largest |V - V_float64| over the rays of a case; **allowed** is the difference that float32 explains
there, median and largest over the rays. Nothing is fitted: the reference (`beam_warp/trace/reference.py`) carries an
interval for each ray and each Gaussian, from a count of the tracer's roundings. A ray's position relative to a Gaussian
is rounded to about 6e-8 × distance, so its whitened distance to 6e-8 × distance / smallest σ; a decision that falls
within that (in front or not, above the cut of 1/255 or not) may go either way; and the early stop may add 1e-4. Each
ray must lie in its own interval, so that a hit that is certain cannot be missed; V must be finite and in [0, 1]; and
what was detected must be what the case put in. Where *allowed* is large, float32 rays do not say what V is: no tracer
of that precision does better, and the remedy is to split the scene or to enlarge its Gaussians. The closest surface of
the same rays must leave light within the same intervals, be finite, and meet the thresholds 0.9, 0.5 and 0.1 in order;
Bernoulli samples, 64 a ray, must have the truth's mean within Bernstein's bound at 1e-6.

**Detected** and **done** say what happened to the input before tracing. Rows that are no Gaussian (NaN, infinity,
negative scales, zero quaternions) are refused by `GaussianCloud(...)`, which names the first, and left out and
counted by `GaussianCloud.leaving_out_invalid(...)`; files behave alike, refused unless read with `drop_invalid=True`
(`--drop-invalid`). What no ray can see (opacity up to 1/255) is dropped. Scales below 1e-7 of the scene's extent or
1e-4 of their Gaussian's largest are raised to that; the truth is then that of the raised Gaussians, and how much
raising itself changes V is told in *done*. Coordinates are relative to the middle of the cloud.
"""

OCCLUSION_TEXT = """\
Shapes with closed forms, tiled with flat Gaussians (one standard deviation a spacing). Two errors are told apart.
*Noise*: the estimate (64 rays a point, automatic offset) against a float64 quadrature of the same Gaussians from the
same ray origins, as the largest difference over the points in stated standard errors; it must be at most 3. The
stated error is a safe one; *true z²* is the mean square of the differences in units of the spread of 16 independent
frames, and should be near 1. *Discretisation*: that quadrature against the smooth shape. Tiles have soft edges and ray
origins lie above the surface, both by a number of spacings: it must shrink with the spacing.
"""


CAPTURES_TEXT = """\
The demo figure's dance, path traced for a dome of cameras, with something wrong, and what `beam reconstruct` makes of
it: the same inspection, steps and report. `beam stability --only reconstruction` runs few steps on small images, for
which two CPU cores take minutes; with `--large` the images are larger and the schedule is the default.

Scores are of two test views of the first and the last frame: PSNR inside the subject's box, median angle of normals,
median error of depth. Drift is the mean distance of the truth's vertices, carried by the Gaussians nearest to them in
the first frame, from where they are in the last one of its segment. *Against the sound capture* is PSNR less that of
*as it is*, of other images where the case shows something else. Cases that a camera is at fault in have two frames.

A case fails if what must be detected was not, if a sound camera is blamed, if something is found where nothing is
wrong, if the last frame is more than {silent:g} dB worse than the first and nothing was said, if frames are missing, or
if the run ends in anything but a reconstruction or a refusal where that is allowed.

- The inspection, before anything starts: `black-image`, `empty-mask`, `missing-image`, `frame-lacks-cameras`,
  `few-cameras` below 8 of them; `camera-exposure` from {inspected:g} stops on, with 10 cameras or more.
- The rig, in the first frame: `camera-contradicts` where a photograph is met far worse than others, or shows the hull
  in colours that the others show where another camera is; `photographs-unlike` where they have nothing in common,
  because labels are mixed or the subject is like a mirror.
- The points of the surface that views share, in every frame: `camera-exposure` from {stops:g} stops on, which is undone
  before the frame is fitted or tracked; `few-cameras` where fewer than two views see most of the surface.
- Tracking: `fast-motion` where a joint is farther from where its last step led than the coarsest level finds;
  `new-surface` where a connected part of the subject is not covered, and `tracking-lost` where PSNR fell far or joints
  are torn apart, upon which the frame becomes a key frame.

Without texture or shading, on mirrors, at what is finer than a pixel and at self-contact nothing is detected, and
nothing need be: the scores say what they cost.
"""


MATERIALS_TEXT = """\
A ball of soft colours (and a sheet, and a ball with creases) under a light, with something wrong, and what becomes of
its base colours. A path tracer for meshes says what every vertex sends towards every camera; Gaussians on the vertices,
drawn with those colours, are its photographs. What is measured from these is compared with the mesh's own base colours:
light transport is another's than the one that is tried, and nothing is left to the chance of a reconstruction.

**Error** is the absolute error of base colour over channels, of the Gaussians that the case is about and of all others;
**stated** the median standard error that comes with it; **within 2 stated** the part of errors that are no larger than
two of those, 95 % or more where the statement is honest. **Wrong without a word** are Gaussians without a flag that are
off by more than {wrong:g} and by more than {stated:g} stated standard errors, in a capture of which nothing was found.

A case fails if what must be found was not, if less than {flagged:.0%} of what it is about is flagged as it must be, if
anything else is found, if more than {silent:.0%} are wrong without a word, or if it ends in anything but materials or a
refusal where that is asked for.

- Before anything is measured (`beam_warp.materials.agreement`): a black environment is refused; `ldr-environment`,
  `clipped-images`, `capture-mismatch`.
- From a first look at what views show (`beam_warp.materials.light`): `environment-turned`, mirrored ones too;
  `environment-unexplained`; `environment-exposure`; `light-unchecked` with fewer than 4 views.
- Of every Gaussian: its flags, and the standard error. Of a mirror-like patch whose roughness is not known neither flag
  nor finding tells: what its views disagree by is in the stated error.
"""


RELIGHTING_TEXT = """\
Subjects and lights on which renderers make acne, fireflies, glowing shells or NaN, and what the deferred renderer and
the path tracer make of them: `beam_warp/stability/relighting_cases/`. What must hold is a closed form in float64, an
image of {times} times the samples, or a bound, each with its reason. That images are finite, with alpha in [0, 1] and
no negative light, is asked of all.

Bounds were derived before anything was drawn, but for the 0.1 of light behind the sheet, which was set after a
first look at what leaked there. Three cases were corrected after a first look, as they asked for what is not so:
coverage inside a ball, whose tiles let up to 0.05 through, not 0.01; the leaking front, which lay so near its
inside that both were one layer; and the catcher, where pixels beside the wall show the wall. A wall of one layer
was kept as a case of its own beside the one of two sides; how dark shadows are is asked since then.

**Measured** is what one image of the deferred renderer, or {seeds} of the path tracer with a seed each, have: for the
latter the mean with its standard error. A value is at fault if it is beyond what is **asked** by more than
{largest_t:g} standard errors (Student's t, 2e-4), and also if those are wider than what is asked: noise is no excuse.
What asks for the same bits, or for nothing at all, has one seed. A renderer that falls short stays in the table and
says so.
"""


@dataclass(frozen=True)
class StabilityResult:
    """Outcomes of one or several runs of the suite.

    Attributes:
        cases: One for each stress case of the tracer, hierarchy and device.
        occlusion: One for each shape with known ambient occlusion.
        captures: One for each capture on which reconstructions fail.
        materials: One for each subject or light on which the measurement of materials fails.
        relighting: One for each subject or light on which relighting fails, and each renderer.
        measured: By device, what measured: version, digest of the code, date.
    """

    cases: tuple[TracingOutcome, ...] = ()
    occlusion: tuple[OcclusionOutcome, ...] = ()
    captures: tuple[CaptureOutcome, ...] = ()
    materials: tuple[MaterialOutcome, ...] = ()
    relighting: tuple[RelightingOutcome, ...] = ()
    measured: Mapping[str, str] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether every verdict is good."""
        return all(outcome.passed for outcome in self.outcomes)

    @property
    def outcomes(self) -> list[Any]:
        """All outcomes of all parts."""
        return [outcome for name in KINDS for outcome in getattr(self, name)]

    def joined(self, other: StabilityResult) -> StabilityResult:
        """Return both results as one, this one's first."""
        parts: dict[str, Any] = {name: getattr(self, name) + getattr(other, name) for name in KINDS}
        return StabilityResult(**parts, measured={**other.measured, **self.measured})

    def measured_now(self) -> StabilityResult:
        """Return the same, stating that the package as it is measured it today."""
        stated = f"beam-warp {__version__}, code {code_digest()[:12]}, {datetime.now(UTC).date()}"
        return replace(self, measured=dict.fromkeys(devices_of(self.outcomes), stated))

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record."""
        parts = {name: [outcome.as_dict() for outcome in getattr(self, name)] for name in KINDS}
        return {"version": __version__, "passed": self.passed, "measured": dict(self.measured), **parts}


KINDS: dict[str, type[OutcomeRecord]] = {
    "cases": TracingOutcome,
    "occlusion": OcclusionOutcome,
    "captures": CaptureOutcome,
    "materials": MaterialOutcome,
    "relighting": RelightingOutcome,
}
"""Kind of the outcomes in each part of a result, by its name."""


def read_result(path: Path) -> StabilityResult:
    """Read what ``beam stability --json`` wrote.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file is something else.
    """
    try:
        record = {"captures": [], "materials": [], "relighting": [], **json.loads(path.read_text(encoding="utf-8"))}
        parts: dict[str, Any] = {name: tuple(map(kind.from_dict, record[name])) for name, kind in KINDS.items()}
        return StabilityResult(**parts, measured=record.get("measured", {}))
    except OSError as error:
        raise MissingFileError(f"beside must be a file, got {path} ({error.strerror}). Check the path.") from error
    except (ValueError, KeyError, TypeError) as error:
        raise AssetFormatError(
            f"beside must be what beam stability --json printed, got {path.name} ({error!r}). Run it again."
        ) from error


def devices_of(outcomes: Sequence[CaseOutcome | OcclusionOutcome]) -> list[str]:
    """Return the devices that occur, in order."""
    return list(dict.fromkeys(outcome.device for outcome in outcomes))


def measured_by(outcomes: Sequence[CaseOutcome | OcclusionOutcome], measured: Mapping[str, str]) -> str:
    """Return a line of what measured some outcomes, device by device."""
    stated = (f"on {device}: {measured.get(device, 'not recorded')}" for device in devices_of(outcomes))
    return f"*Measured {'; '.join(stated)}.*" if outcomes else ""


def verdict_of(outcomes: Sequence[TracingOutcome]) -> str:
    """Return ``ok``, or the first fault of each that failed."""
    return "; ".join(f"{o.device}, {o.hierarchy}: {o.faults[0]}" for o in outcomes if o.faults) or "ok"


def allowed_by(outcome: TracingOutcome) -> str:
    """Return the median and the largest error that rounding explains, for a table."""
    return f"{_number(outcome.typical_bound)}, {_number(outcome.bound)}" if outcome.bound > 0.0 else "0"


def markdown(result: StabilityResult, command: str, before: str = "") -> str:
    """Return the page.

    Args:
        result: Outcomes of any number of devices and hierarchies.
        command: The command that makes the page, for its text.
        before: The page as it is. Parts for which the result has no outcomes stay as they are there.
    """
    headings = "|".join(section.title for section in SECTIONS.values())
    tracing, *others = re.split(rf"^(?={headings})", before, flags=re.MULTILINE)
    parts = [_tracing(result, command) if result.cases or not before else tracing]
    for name, section in SECTIONS.items():
        kept = [part for part in others if part.startswith(section.title)]
        parts.append(section.markdown(getattr(result, name), result.measured) or "".join(kept[-1:]))
    return "\n".join(part.rstrip() + "\n" for part in parts if part)


@dataclass(frozen=True)
class Section:
    """A part of the page with a table for each device, one row an outcome.

    Attributes:
        title: Its heading.
        text: How to read it.
        cases: Cases, in the order of the rows.
        titles: Titles of the columns.
        cells: Returns the cells of an outcome that follow those of its case; it is also given all of its table.
        facts: Returns a line about the outcomes of a table.
        common: Returns what the outcomes of a table have in common.
    """

    title: str
    text: str
    cases: Sequence[StabilityCase[Any]]
    titles: Sequence[str]
    cells: Callable[[Any, Any], Sequence[str]]
    facts: Callable[[Any], str]
    common: Callable[[Any], Hashable] = attrgetter("device")

    def markdown(self, outcomes: Sequence[CaseOutcome], measured: Mapping[str, str]) -> str:
        """Return this part of the page; empty if there are no outcomes."""
        lines = [self.title, "", self.text, measured_by(outcomes, measured), ""]
        for common in dict.fromkeys(map(self.common, outcomes)):
            same = [outcome for outcome in outcomes if self.common(outcome) == common]
            table = case_table(self.titles, self.cases, same, lambda outcome, same=same: self.cells(outcome, same))
            lines += [self.facts(same), "", table]
        return "\n".join(lines) if outcomes else ""


def _material_facts(same: Sequence[MaterialOutcome]) -> str:
    """Return the size of the subjects on one device, and the time of all."""
    return (
        f"{same[0].device}: {same[0].gaussians:,} Gaussians, {same[0].views} views; measured in "
        f"{sum(outcome.seconds for outcome in same):.0f} s in all."
    )


def _relighting_facts(same: Sequence[RelightingOutcome]) -> str:
    """Return the size of the images on one device, and how many cases hold."""
    return (
        f"{same[0].device}: images of up to {max(row.size[0] for row in same)} pixels a side, up to "
        f"{max(row.gaussians for row in same):,} Gaussians, {max(row.samples for row in same)} paths a pixel; "
        f"{sum(row.passed for row in same)} of {len(same)} hold."
    )


def _capture_facts(same: Sequence[CaptureOutcome]) -> str:
    """Return the size of the captures on one device, and the time of all."""
    return (
        f"{same[0].device}: {same[0].cameras} cameras of {' x '.join(map(str, same[0].size))} pixels, "
        f"{same[0].frames} frames, up to {max(outcome.gaussians for outcome in same):,} Gaussians; reconstructed in "
        f"{sum(outcome.seconds for outcome in same):.0f} s in all."
    )


SECTIONS = {
    "captures": Section(
        "## Captures on which reconstructions fail",
        CAPTURES_TEXT.format(silent=captures.SILENT_LOSS_DB, inspected=INSPECTED_STOPS, stops=EXPOSURE_STOPS),
        CAPTURE_CASES,
        captures.TITLES,
        captures.cells,
        _capture_facts,
        attrgetter("device", "size"),
    ),
    "materials": Section(
        "## Materials",
        MATERIALS_TEXT.format(
            wrong=materials.WRONG, stated=materials.STATED, flagged=materials.FLAGGED, silent=materials.SILENT_PART
        ),
        MATERIAL_CASES,
        materials.TITLES,
        lambda outcome, _: materials.cells(outcome),
        _material_facts,
    ),
    "relighting": Section(
        "## Relighting",
        RELIGHTING_TEXT.format(
            times=relighting.REFERENCE_TIMES, seeds=relighting.SEEDS, largest_t=relighting.LARGEST_T
        ),
        RELIGHTING_CASES,
        relighting.TITLES,
        lambda outcome, _: relighting.cells(outcome),
        _relighting_facts,
    ),
}
"""Parts of the page after those about tracing, by their names in a result."""


def case_table(
    titles: Sequence[str], cases: Sequence[Any], outcomes: Sequence[Any], cells: Callable[[Any], Sequence[str]]
) -> str:
    """Return a row for every outcome in the order of the cases: name, how others fail, what is asked, its cells."""
    return markdown_table(
        titles,
        [
            (case.name, case.fails, case.must, *cells(outcome))
            for case in cases
            for outcome in outcomes
            if outcome.case == case.name
        ],
    )


def _tracing(result: StabilityResult, command: str) -> str:
    """Return the part about ray tracing."""
    parts = ["# Stability", HOW_TO_READ.format(command=command), measured_by(result.cases, result.measured)]
    parts += ["## Stress cases", _tracing_table(result.cases)]
    parts += ["## Ambient occlusion of known shapes", OCCLUSION_TEXT, _occlusion_table(result.occlusion)]
    return "\n".join(part.rstrip() + "\n" for part in parts)


def _tracing_table(outcomes: Sequence[TracingOutcome]) -> str:
    """Return one row a case: the worst error of its hierarchies on every device."""
    devices = devices_of(outcomes)
    titles = ["case", "a tracer without precautions", "detected", "done", "result", "allowed: median, largest"]
    rows = []
    for case in CASES:
        same = [outcome for outcome in outcomes if outcome.case == case.name]
        if same:
            first = same[0]
            errors = [[outcome.error for outcome in same if outcome.device == device] for device in devices]
            rows.append(
                [case.name, case.fails, first.detected, first.done, first.did, allowed_by(first)]
                + [_number(max(found)) if found else "not run" for found in errors]
                + [verdict_of(same)]
            )
    return markdown_table([*titles, *(f"error, {device}" for device in devices), "verdict"], rows)


def _occlusion_table(outcomes: Sequence[OcclusionOutcome]) -> str:
    """Return one row a shape and spacing."""
    devices = devices_of(outcomes)
    titles = ["shape", "closed form", "spacing", "Gaussians", "smooth", "tiled", "discretisation"]
    titles += [f"estimate, largest z, true z², {device}" for device in devices]
    rows = []
    for shape in SHAPES:
        for spacing in dict.fromkeys(o.spacing for o in outcomes if o.shape == shape.name):
            tiles = [o for o in outcomes if (o.shape, o.spacing) == (shape.name, spacing)]
            smooth = (tiles[0].closed_form, tiles[0].quadrature, tiles[0].discretisation)
            rows.append(
                [shape.name, shape.formula, f"{spacing:g}", f"{tiles[0].gaussians:,}"]
                + [f"{value:.4f}" for value in smooth]
                + [_estimates([o for o in tiles if o.device == device]) for device in devices]
                + ["ok" if all(o.passed for o in tiles) else "**beyond 3 standard errors**"]
            )
    return markdown_table([*titles, "verdict"], rows)


def write_page(path: Path, result: StabilityResult, command: str) -> None:
    """Write the page whole or not at all. Parts for which the result has no outcomes stay as they were there.

    Raises:
        OutputError: The page cannot be written.
    """
    with replacing(path) as temporary:
        before = path.read_text(encoding="utf-8") if path.is_file() else ""
        temporary.write_text(markdown(result, command, before), encoding="utf-8")


def _estimates(outcomes: Sequence[OcclusionOutcome]) -> str:
    """Return the estimate that is farthest from its truth, for a table, with its z-score and the mean square of all."""
    if not outcomes:
        return "not run"
    worst = max(outcomes, key=lambda outcome: outcome.largest_z)
    return f"{worst.estimate:.4f}, {worst.largest_z:.2f}, {worst.chi_square:.2f}"


def _number(value: float) -> str:
    """Return an error for a table."""
    return "0" if value == 0.0 else f"{value:.1e}"
