"""Studies of cost against error over named factors, measured into a table that can be resumed.

A study names its axes, the settings to measure, and a function that measures one. Nothing here knows what is measured:
tracing and materials bring their own axes. `beam_warp.study.picture` and `beam_warp.study.page` draw the table.
"""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_number
from beam_warp.converters.staging import require_writable
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError, OutputError
from beam_warp.image.files import replacing
from beam_warp.jobs.listeners import StageProgress, no_progress

Level = str | int | float

Settings = Mapping[str, Level]
"""Axis name → level. An axis that does not apply to a setting is left out."""

FORMAT = "beam-chart 1"
"""First words of a table's file; the number changes with the layout."""

TOLERANCE = 0.02
"""Errors that differ by less than this part count as equal on a frontier; their intervals are wider by far."""

CONFIDENCE = 0.95
RESAMPLES = 1000

PACE = "Pace"
"""Title of the note on how steady the machine was."""

SHAKY = 1.3
"""A chart warns its reader if one setting's costs within a run have a ratio of upper to lower quartile above this."""

PROBE_EVERY = 16
"""Settings between two measurements of the first one, which tell whether the machine kept its pace."""


@dataclass(frozen=True)
class Axis:
    """One factor.

    Attributes:
        name: Column of the table.
        title: Name for people.
        levels: Values of the factor, the default first; steps of a ladder are numbers in rising order.
        unit: Follows the level in labels, such as ``rays``.
        sentence: One sentence that says what the levels mean.
    """

    name: str
    title: str
    levels: tuple[Level, ...]
    unit: str = ""
    sentence: str = ""

    def label(self, level: Level) -> str:
        """Return a level as people read it."""
        return f"{level} {self.unit}".strip()


@dataclass(frozen=True)
class Metric:
    """One kind of error.

    Attributes:
        name: Stem of three columns: value, low and high.
        title: Name for people.
        unit: Unit of the error; empty for a ratio.
        color: Axis that colours distinguish; empty for none.
        marker: Axis that marker shapes distinguish.
        line: Axis that line styles distinguish.
        by: Axis on whose levels alone the error depends, whatever a setting costs, such as a bias. The error is drawn
            against those levels and has no frontier. Empty for none.
        apart: Axis whose levels have truths of their own. Only settings with its first level compete for the frontier;
            the others are drawn faintly. Empty for none.
        floor: Error of the reference itself; smaller errors cannot be told apart. 0 if there is none.
        sentence: One sentence that says how to read the error.
    """

    name: str
    title: str
    unit: str = ""
    color: str = ""
    marker: str = ""
    line: str = ""
    by: str = ""
    apart: str = ""
    floor: float = 0.0
    sentence: str = ""


class Interval(NamedTuple):
    """A value with its confidence interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of_median(cls, values: ArrayLike) -> Interval:
        """Return the median of repeats, with the smallest and largest: of few repeats, more cannot be said."""
        array = np.asarray(values, np.float64)
        return cls(float(np.median(array)), float(array.min()), float(array.max()))

    @classmethod
    def of_root_mean_square(cls, squares: ArrayLike, sizes: ArrayLike | None = None, *, seed: int = 0) -> Interval:
        """Return the root of the mean of squared errors, with its percentile bootstrap, `CONFIDENCE` wide.

        Args:
            squares: Squared errors of N independent points, or their sums over N independent clusters, ``(N,)``.
            sizes: Number of errors in each cluster, ``(N,)``; None if each is one. Empty clusters are left out.
            seed: Seed of the resamples.

        Source: Efron 1979.
        """
        sums = np.asarray(squares, np.float64)
        counts = np.ones(len(sums)) if sizes is None else np.asarray(sizes, np.float64)
        sums, counts = sums[counts > 0.0], counts[counts > 0.0]
        generator = np.random.default_rng(seed)
        # How often each cluster is drawn in a resample is multinomial: no index array of resamples × clusters.
        drawn = generator.multinomial(len(sums), np.full(len(sums), 1.0 / len(sums)), size=RESAMPLES)
        tail = (1.0 - CONFIDENCE) / 2.0
        low, high = np.sqrt(np.quantile(drawn @ sums / (drawn @ counts), [tail, 1.0 - tail]))
        value = float(np.sqrt(sums.sum() / counts.sum()))
        return cls(value, min(value, float(low)), max(value, float(high)))


@dataclass(frozen=True)
class Row:
    """One measured setting: its cost, and its error by metric name."""

    settings: Settings
    cost: Interval
    errors: Mapping[str, Interval]


@dataclass(frozen=True)
class StudySubject:
    """The subject of a table: all that a drawing needs beside the rows.

    Attributes:
        name: Stem of the files.
        title: One line for the top of the chart.
        axes: Factors, in the order in which labels name them.
        metrics: Errors.
        cost: Name of the cost, for people.
        cost_unit: Unit of the cost.
        ladder: Axis whose steps are joined by lines.
        notes: Title → text: scene, device, versions, references, what was left out.
        planned: Number of settings in the plan.

    Raises:
        InvalidOptionError: Two columns have one name, or an axis is named that does not exist.
    """

    name: str
    title: str
    axes: tuple[Axis, ...]
    metrics: tuple[Metric, ...]
    cost: str
    cost_unit: str
    ladder: str
    notes: Mapping[str, str] = field(default_factory=dict)
    planned: int = 0

    def __post_init__(self) -> None:
        """Check that names are unique and lead somewhere."""
        names = [axis.name for axis in self.axes] + ["cost"] + [metric.name for metric in self.metrics]
        if len(set(names)) < len(names):
            raise InvalidOptionError(f"names of axes and metrics must be unique, got {names}. Rename one of them.")
        named = {self.ladder}.union(*({m.color, m.marker, m.line, m.by, m.apart} - {""} for m in self.metrics))
        unknown = named - {axis.name for axis in self.axes}
        if unknown:
            raise InvalidOptionError(f"named axes must be among {names}, got {sorted(unknown)}. Declare them.")

    def axis(self, name: str) -> Axis:
        """Return an axis by name."""
        return next(axis for axis in self.axes if axis.name == name)

    def label(self, settings: Settings) -> str:
        """Return settings in words: the axes that have a choice."""
        shown = [axis for axis in self.axes if axis.name in settings and len(axis.levels) > 1]
        return ", ".join(f"{axis.name} {settings[axis.name]}" for axis in shown)


@dataclass(frozen=True)
class Study:
    """A subject and how to measure it.

    Attributes:
        subject: What is measured.
        plan: Settings, the most telling first: a budget cuts off the end.
        measure: Measures one setting.
        work: Returns the work of one setting, in proportion to the time that measuring it takes.
    """

    subject: StudySubject
    plan: Sequence[Settings]
    measure: Callable[[Settings], Row]
    work: Callable[[Settings], int]


@dataclass(frozen=True)
class Table:
    """The measured rows of a study."""

    subject: StudySubject
    rows: tuple[Row, ...]

    def frontier(self, metric: Metric) -> list[Row]:
        """Return the rows that no other with the same truth beats in both cost and error, cheapest first."""
        rows = [row for row in self.rows_of(metric) if not self.is_apart(row, metric)]
        if not rows or metric.by:
            return []
        costs, errors = [row.cost.value for row in rows], [row.errors[metric.name].value for row in rows]
        kept = pareto_frontier(costs, errors, TOLERANCE)
        return [rows[index] for index in kept]

    def is_apart(self, row: Row, metric: Metric) -> bool:
        """Return whether a row's truth is another than the one that the frontier is about."""
        return bool(metric.apart) and row.settings[metric.apart] != self.subject.axis(metric.apart).levels[0]

    def rows_of(self, metric: Metric) -> list[Row]:
        """Return the rows that have this error."""
        return [row for row in self.rows if metric.name in row.errors]


def pareto_frontier(costs: ArrayLike, errors: ArrayLike, tolerance: float = 0.0) -> NDArray[np.int64]:
    """Return the indices of the pairs that no other pair beats, cheapest first.

    One pair beats another if it is at most as large in both and smaller in one; equal pairs beat each other never. With
    a tolerance, what costs more must bring an error that is smaller by more than this part of it.
    """
    cost, error = np.asarray(costs, np.float64), np.asarray(errors, np.float64)
    kept: list[int] = []
    for index in np.lexsort((error, cost)):
        last = kept[-1] if kept else None
        same = last is not None and error[index] == error[last] and cost[index] == cost[last]
        if last is None or same or error[index] < (1.0 - tolerance) * error[last]:
            kept.append(int(index))
    return np.array(kept, np.int64)


def run_study(
    study: Study, folder: Path, *, budget_seconds: float = math.inf, progress: StageProgress = no_progress
) -> tuple[Table, list[Settings]]:
    """Measure a study's plan into ``folder/NAME.csv``.

    Rows are kept in ``NAME.partial.csv`` as they come, and become ``NAME.csv`` in the end. A run that was stopped, or
    that a budget cut short, continues if it is started again with the same subject; another subject starts anew. The
    first setting is measured again now and then; how far its cost varied is noted as "Pace".

    Args:
        study: What to measure.
        folder: Where the table goes; it must exist.
        budget_seconds: Settings that would, at the rate so far, end later than this are skipped. The first of the plan
            is always measured.
        progress: Called with ("measure", work done, work in all).

    Returns:
        The table, and the settings that the budget left out.

    Raises:
        OutputError: The folder cannot be written.
    """
    require_number("budget_seconds", budget_seconds, 0.0)
    subject = replace(study.subject, planned=len(study.plan))
    final, partial = table_paths(folder, subject)
    require_writable(final)
    try:
        rows = _earlier_rows(subject, partial) or _earlier_rows(subject, final)
        write_table(Table(subject, tuple(rows)), partial)
        done = {_key(subject, row.settings) for row in rows}
        left = [settings for settings in study.plan if _key(subject, settings) not in done]
        total, measured, skipped, probes = sum(map(study.work, left)), 0, [], []
        started = time.perf_counter()
        for settings in left:
            work = study.work(settings)
            elapsed = time.perf_counter() - started
            if measured and elapsed + elapsed / measured * work > budget_seconds:
                skipped.append(settings)
                continue
            row = study.measure(settings)
            with partial.open("a", encoding="utf-8", newline="") as file:
                file.write(_line(_cells(subject, row)))
            rows.append(row)
            measured += work
            progress("measure", measured, total)
            if not probes:
                probes.append(row.cost.value)
            elif len(rows) % PROBE_EVERY == 0 or settings is left[-1]:
                probes.append(study.measure(left[0]).cost.value)
        table = Table(_with_pace(subject, probes), tuple(rows))
        write_table(table, final)
        partial.unlink()
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"{partial} must be writable, got {error.strerror}. Free space or choose another.") from error
    return table, skipped


def _with_pace(subject: StudySubject, probes: Sequence[float]) -> StudySubject:
    """Return the subject with a note on how the cost of one setting, measured again and again, varied."""
    if len(probes) < 2:
        return subject
    fast, low, high, slow = np.quantile(probes, (0.0, 0.25, 0.75, 1.0)) / np.median(probes)
    pace = f"one setting, measured {len(probes)} times during the run, cost {fast:.2f} to {slow:.2f} of its median"
    if high > SHAKY * low:
        pace += ": the machine was busy, so small differences in cost mean nothing; measure again on a quiet one"
    return replace(subject, notes={**subject.notes, PACE: pace})


def table_paths(folder: Path, subject: StudySubject) -> tuple[Path, Path]:
    """Return where a subject's table goes when it is done, and where it is until then."""
    return folder / f"{subject.name}.csv", folder / f"{subject.name}.partial.csv"


def write_table(table: Table, path: Path) -> None:
    """Write a table: one comment line that holds the subject as JSON, then CSV.

    Raises:
        OutputError: The file cannot be written.
    """
    with replacing(path) as temporary:
        text = _head(table.subject) + "".join(_line(_cells(table.subject, row)) for row in table.rows)
        temporary.write_text(text, encoding="utf-8", newline="")


def read_table(path: Path) -> Table:
    """Read a table; a last line without its end, from a run that was killed, is left out.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file is no table of a study; the message names the line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise _malformed(path, 1, "it is not text") from error
    except OSError as error:
        raise MissingFileError(
            f"table must be a readable file, got {path} ({error.strerror}). Check the path."
        ) from error
    lines = text[: text.rfind("\n") + 1].splitlines()
    if len(lines) < 2 or not lines[0].startswith(f"# {FORMAT} "):
        raise _malformed(path, 1, f"its first line does not begin with '# {FORMAT}'")
    try:
        subject = _subject_of(json.loads(lines[0].removeprefix(f"# {FORMAT} ")))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise _malformed(path, 1, f"its description does not parse ({error})") from error
    if next(csv.reader([lines[1]])) != _columns(subject):
        raise _malformed(path, 2, "its columns are not those of its description")
    rows = []
    for number, line in enumerate(lines[2:], start=3):
        try:
            rows.append(_row(subject, next(csv.reader([line]))))
        except (ValueError, StopIteration) as error:
            raise _malformed(path, number, str(error)) from error
    return Table(subject, tuple(rows))


def _malformed(path: Path, line: int, why: str) -> AssetFormatError:
    return AssetFormatError(f"table must be a CSV that beam chart wrote, got {path}:{line}: {why}. Measure it again.")


def _subject_of(value: dict[str, Any]) -> StudySubject:
    """Return the subject of its JSON form."""
    axes = tuple(Axis(**{**axis, "levels": tuple(axis["levels"])}) for axis in value.pop("axes"))
    metrics = tuple(Metric(**metric) for metric in value.pop("metrics"))
    return StudySubject(axes=axes, metrics=metrics, **value)


def _earlier_rows(subject: StudySubject, path: Path) -> list[Row]:
    """Return the rows of a run of the same subject that did not reach its end; none if there is no such table."""
    if not path.exists():
        return []
    try:
        earlier = read_table(path)
    except AssetFormatError:
        return []
    notes = {title: text for title, text in earlier.subject.notes.items() if title != PACE}
    unfinished = len(earlier.rows) < subject.planned
    return list(earlier.rows) if unfinished and replace(earlier.subject, notes=notes) == subject else []


def _key(subject: StudySubject, settings: Settings) -> tuple[str, ...]:
    return tuple(str(settings.get(axis.name, "")) for axis in subject.axes)


def _columns(subject: StudySubject) -> list[str]:
    numbers = ["cost", *(metric.name for metric in subject.metrics)]
    return [axis.name for axis in subject.axes] + [name + end for name in numbers for end in ("", "_low", "_high")]


def _head(subject: StudySubject) -> str:
    return f"# {FORMAT} {json.dumps(asdict(subject), ensure_ascii=False)}\n" + _line(_columns(subject))


def _line(cells: Sequence[str]) -> str:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue()


def _cells(subject: StudySubject, row: Row) -> list[str]:
    unknown = (set(row.settings) - {axis.name for axis in subject.axes}) | (
        set(row.errors) - {metric.name for metric in subject.metrics}
    )
    if unknown:
        raise InvalidOptionError(
            f"row must have the axes and metrics of its study, got {sorted(unknown)}. Declare them."
        )
    intervals = [row.cost, *(row.errors.get(metric.name) for metric in subject.metrics)]
    numbers = ["" if v is None else repr(float(n)) for v in intervals for n in (v or (0.0,) * 3)]
    return [*_key(subject, row.settings), *numbers]


def _row(subject: StudySubject, cells: Sequence[str]) -> Row:
    """Return a row of its cells; levels are looked up in the axes, so that numbers come back as numbers."""
    columns = _columns(subject)
    if len(cells) != len(columns):
        raise ValueError(f"{len(cells)} cells in place of {len(columns)}")
    settings: dict[str, Level] = {}
    for axis, cell in zip(subject.axes, cells, strict=False):
        level = next((level for level in axis.levels if str(level) == cell), None)
        if level is None and cell:
            raise ValueError(f"{cell!r} is no level of {axis.name}")
        if level is not None:
            settings[axis.name] = level
    numbers = cells[len(subject.axes) :]
    intervals = []
    for start in range(0, len(numbers), 3):
        part = numbers[start : start + 3]
        if not any(part):
            intervals.append(None)
            continue
        interval = Interval(*map(float, part))
        if not (0.0 <= interval.low <= interval.value <= interval.high < math.inf):
            raise ValueError(f"{', '.join(part)} is no interval")
        intervals.append(interval)
    if intervals[0] is None:
        raise ValueError("no cost")
    errors = {m.name: i for m, i in zip(subject.metrics, intervals[1:], strict=True) if i is not None}
    return Row(settings, intervals[0], errors)
