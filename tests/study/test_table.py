"""Studies, tables, frontiers and drawings on made-up measurements: nothing here traces."""

import json
import math
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from beam_warp.checks import require_package
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError, OutputError
from beam_warp.study.page import write_page
from beam_warp.study.picture import significant, write_image
from beam_warp.study.table import (
    Axis,
    Interval,
    Metric,
    Row,
    Study,
    StudySubject,
    Table,
    pareto_frontier,
    read_table,
    run_study,
    write_table,
)

SUBJECT = StudySubject(
    name="toy",
    title='Error against time of a toy </script> & "quotes", ‰ of 1/0, on nothing',
    axes=(
        Axis("steps", "Steps", (1, 2, 4), "steps"),
        Axis("method", "Method", ("plain, with a comma", "fast"), sentence="How."),
        Axis("gain", "Gain", (0.5, 1.0)),
    ),
    metrics=(
        Metric("error", "Error of everything", "m", color="method", apart="gain", floor=0.01, sentence="Noise."),
        Metric("shift", "Shift by gain", by="gain"),
    ),
    cost="Time for all",
    cost_unit="s",
    ladder="steps",
    notes={"Device": "none"},
)


def toy_row(settings):
    steps = settings["steps"]
    cost = steps * (1.0 if settings["method"] == "fast" else 3.0)
    error = 1.0 / steps + (0.1 if settings["method"] == "fast" else 0.0)
    errors = {"error": Interval(error, 0.9 * error, 1.1 * error)}
    if settings["method"] == "fast":
        shift = 0.25 * (settings["gain"] - 0.5)
        errors["shift"] = Interval(shift, shift, shift)
    return Row(settings, Interval(cost, cost, 2.0 * cost), errors)


PLAN = [
    {"steps": steps, "method": method, "gain": gain}
    for gain in (0.5, 1.0)
    for method in ("plain, with a comma", "fast")
    for steps in (1, 2, 4)
]
TABLE = Table(replace(SUBJECT, planned=len(PLAN)), tuple(toy_row(settings) for settings in PLAN))


def study(measured=None, plan=PLAN):
    def measure(settings):
        if measured is not None:
            measured.append(settings)
        return toy_row(settings)

    return Study(SUBJECT, plan, measure, lambda settings: settings["steps"])


class TestFrontier:
    @given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=30))
    def test_is_what_no_other_beats(self, pairs):
        def beats(a, b):
            return a[0] <= b[0] and a[1] <= b[1] and a != b

        expected = {k for k, pair in enumerate(pairs) if not any(beats(other, pair) for other in pairs)}
        kept = pareto_frontier([p[0] for p in pairs], [p[1] for p in pairs])
        assert set(kept.tolist()) == expected
        assert [pairs[k] for k in kept] == sorted(pairs[k] for k in kept)

    @given(st.lists(st.tuples(st.integers(0, 6), st.integers(1, 6)), max_size=30), st.floats(0.0, 0.5))
    def test_with_a_tolerance_leaves_out_what_brings_little(self, pairs, tolerance):
        kept = [pairs[k] for k in pareto_frontier([p[0] for p in pairs], [p[1] for p in pairs], tolerance)]
        whole = [pairs[k] for k in pareto_frontier([p[0] for p in pairs], [p[1] for p in pairs])]
        assert set(kept) <= set(whole)
        for cost, error in whole:
            assert any(other[0] <= cost and (1.0 - tolerance) * other[1] <= error for other in kept)

    def test_of_a_table_is_among_rows_with_one_truth(self):
        frontier = TABLE.frontier(SUBJECT.metrics[0])
        assert [(row.settings["steps"], row.settings["method"]) for row in frontier] == [
            (1, "fast"),
            (2, "fast"),
            (4, "fast"),
            (4, "plain, with a comma"),
        ]
        assert {row.settings["gain"] for row in frontier} == {0.5}
        assert TABLE.frontier(SUBJECT.metrics[1]) == []


class TestInterval:
    def test_median_of_repeats(self):
        assert Interval.of_median([3.0, 1.0, 8.0]) == Interval(3.0, 1.0, 8.0)

    def test_bootstrap_covers_the_truth_as_often_as_it_says(self, rng):
        # Errors are normal with variance 1. The percentile bootstrap is short on so few points of a skewed quantity:
        # 92.6 % were inside in 4,000 studies; the bounds are four standard errors of 400 around that.
        inside = [
            interval.low <= 1.0 <= interval.high
            for k in range(400)
            for interval in [Interval.of_root_mean_square(rng.normal(size=60) ** 2, seed=k)]
        ]
        assert 0.926 - 0.053 < np.mean(inside) < 0.926 + 0.053

    def test_no_error_at_all(self):
        assert Interval.of_root_mean_square(np.zeros(5)) == Interval(0.0, 0.0, 0.0)


class TestTable:
    def test_round_trip(self, tmp_path):
        write_table(TABLE, tmp_path / "toy.csv")
        back = read_table(tmp_path / "toy.csv")
        assert back == TABLE
        assert isinstance(back.rows[0].settings["steps"], int)
        assert [path.name for path in tmp_path.iterdir()] == ["toy.csv"]

    def test_a_line_cut_anywhere_costs_that_line_only(self, tmp_path):
        write_table(TABLE, tmp_path / "toy.csv")
        text = (tmp_path / "toy.csv").read_bytes()
        last = text[:-1].rfind(b"\n") + 1
        for cut in range(last, len(text)):
            (tmp_path / "cut.csv").write_bytes(text[:cut])
            assert read_table(tmp_path / "cut.csv").rows == TABLE.rows[:-1]

    @pytest.mark.parametrize(
        ("old", "new", "says"),
        [
            ("# beam-chart 1", "# beam-chart 9", "toy.csv:1: its first line does not begin"),
            ('"ladder": "steps"', '"ladder": "stairs"', "toy.csv:1: its description does not parse"),
            ('{"name": "toy"', '{"name" "toy"', "toy.csv:1: its description does not parse"),
            ("steps,method", "step,method", "toy.csv:2: its columns"),
            ("\n4,fast,0.5", "\n5,fast,0.5", "toy.csv:8: '5' is no level of steps"),
            ("\n1,fast,0.5,1.0", "\n1,fast,0.5,nan", "toy.csv:6: nan, 1.0, 2.0 is no interval"),
            ("\n1,fast,0.5,1.0,1.0,2.0", "\n1,fast,0.5,,,", "toy.csv:6: no cost"),
            ("\n1,fast,0.5,1.0", "\n1,fast,0.5,one", "toy.csv:6: could not convert"),
            ("\n1,fast,0.5,", "\n1,fast,", "toy.csv:6: 11 cells in place of 12"),
        ],
    )
    def test_malformed(self, tmp_path, old, new, says):
        path = tmp_path / "toy.csv"
        write_table(TABLE, path)
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        with pytest.raises(AssetFormatError, match=re.escape(says)):
            read_table(path)

    def test_not_there_and_not_text(self, tmp_path):
        with pytest.raises(MissingFileError, match="table must be a readable file"):
            read_table(tmp_path / "none.csv")
        (tmp_path / "image.csv").write_bytes(b"\x89PNG\xff\xfe")
        with pytest.raises(AssetFormatError, match="it is not text"):
            read_table(tmp_path / "image.csv")

    def test_undeclared_columns_are_refused(self, tmp_path):
        row = toy_row(PLAN[0])
        with pytest.raises(InvalidOptionError, match=r"got \['colour'\]"):
            write_table(Table(SUBJECT, (replace(row, settings={"colour": "red"}),)), tmp_path / "toy.csv")


class TestSubject:
    def test_names_must_be_unique_and_lead_somewhere(self):
        with pytest.raises(InvalidOptionError, match="names of axes and metrics must be unique"):
            replace(SUBJECT, metrics=(Metric("steps", "Steps again"),))
        with pytest.raises(InvalidOptionError, match=r"named axes must be among .*, got \['hue'\]"):
            replace(SUBJECT, metrics=(Metric("error", "Error", color="hue"),))

    def test_settings_in_words(self):
        assert SUBJECT.label({"steps": 4, "gain": 0.5}) == "steps 4, gain 0.5"


class TestRun:
    def test_measures_the_plan_in_order(self, tmp_path):
        measured, seen = [], []
        table, skipped = run_study(
            study(measured), tmp_path, progress=lambda stage, done, total: seen.append((stage, done, total))
        )
        assert table.rows == TABLE.rows
        assert not skipped
        assert measured[: len(PLAN)] == PLAN
        assert measured[len(PLAN) :] == [PLAN[0]]  # the pace, once more at the end
        assert "cost 1.00 to 1.00 of its median" in table.subject.notes["Pace"]
        assert seen[-1] == ("measure", 28, 28)
        assert [path.name for path in tmp_path.iterdir()] == ["toy.csv"]
        assert read_table(tmp_path / "toy.csv") == table

    def test_goes_on_where_it_was_stopped(self, tmp_path):
        def measure(settings):
            if settings == PLAN[5]:
                raise KeyboardInterrupt
            return toy_row(settings)

        with pytest.raises(KeyboardInterrupt):
            run_study(replace(study(), measure=measure), tmp_path)
        partial = tmp_path / "toy.partial.csv"
        assert len(read_table(partial).rows) == 5
        partial.write_bytes(partial.read_bytes()[:-7])  # killed while it wrote the fifth
        measured = []
        table, _ = run_study(study(measured), tmp_path)
        assert measured[:8] == PLAN[4:]
        assert table.rows == TABLE.rows
        assert not partial.exists()

    @pytest.mark.parametrize("broken", [False, True])
    def test_another_study_starts_anew(self, tmp_path, broken):
        write_table(Table(replace(SUBJECT, title="another"), TABLE.rows[:3]), tmp_path / "toy.partial.csv")
        if broken:
            (tmp_path / "toy.partial.csv").write_text("something else\n")
        measured = []
        run_study(study(measured), tmp_path)
        assert measured[:12] == PLAN

    def test_budget_skips_what_does_not_fit_and_a_second_call_goes_on(self, tmp_path, monkeypatch):
        now = [0.0]
        monkeypatch.setattr("beam_warp.study.table.time.perf_counter", lambda: now[0])

        def measure(settings):
            now[0] += settings["steps"]  # a second for each unit of work
            return toy_row(settings)

        timed = replace(study(), measure=measure)
        table, skipped = run_study(timed, tmp_path, budget_seconds=10.0)
        assert len(table.rows) + len(skipped) == len(PLAN)
        assert now[0] <= 10.0 + 1.0  # and one probe of the pace
        assert table.subject.planned == len(PLAN)
        table, skipped = run_study(timed, tmp_path)
        assert not skipped
        assert {str(row.settings) for row in table.rows} == {str(settings) for settings in PLAN}

    def test_the_first_setting_is_always_measured(self, tmp_path):
        table, skipped = run_study(study(), tmp_path, budget_seconds=0.0)
        assert len(table.rows) == 1
        assert len(skipped) == 11

    def test_a_busy_machine_is_noted(self, tmp_path):
        costs = iter([1.0] * 12 + [2.0])

        def measure(settings):
            cost = next(costs)
            return replace(toy_row(settings), cost=Interval(cost, cost, cost))

        table, _ = run_study(replace(study(), measure=measure), tmp_path)
        assert "the machine was busy" in table.subject.notes["Pace"]

    def test_bad_folder_and_budget(self, tmp_path):
        with pytest.raises(OutputError, match="output folder must exist"):
            run_study(study(), tmp_path / "none")
        with pytest.raises(InvalidOptionError, match="budget_seconds must be a number"):
            run_study(study(), tmp_path, budget_seconds=math.nan)


class TestImage:
    def test_is_written_whole(self, tmp_path):
        write_image(TABLE, tmp_path / "toy.png")
        with Image.open(tmp_path / "toy.png") as image:
            assert image.width >= 1200
        assert [path.name for path in tmp_path.iterdir()] == ["toy.png"]

    @pytest.mark.parametrize("count", [1, 5])
    def test_draws_an_unfinished_table_and_errors_of_zero(self, tmp_path, count):
        nothing = Interval(0.0, 0.0, 0.0)
        rows = tuple(replace(row, errors={"error": nothing, "shift": nothing}) for row in TABLE.rows[:count])
        for drawn in (TABLE.rows[:count], rows):
            write_image(Table(TABLE.subject, drawn), tmp_path / "toy.png")

    def test_needs_a_row(self, tmp_path):
        with pytest.raises(InvalidOptionError, match="table must have at least one row"):
            write_image(Table(SUBJECT, ()), tmp_path / "toy.png")

    def test_absent_package_is_named_with_its_extra(self):
        with pytest.raises(InvalidOptionError, match=r"no_such_package must be installed.*beam-warp\[charts\]"):
            require_package("no_such_package")

    @pytest.mark.parametrize(
        ("value", "text"),
        [(0.0, "0"), (0.012345, "0.0123"), (1.0, "1.00"), (12345.6, "12,346"), (1e-5, "1.00e-05"), (3e7, "3.00e+07")],
    )
    def test_numbers(self, value, text):
        assert significant(value) == text


class Loaded(HTMLParser):
    """What a page loads from elsewhere, its elements, and its data."""

    def __init__(self):
        super().__init__()
        self.links, self.tags, self.data, self.inside = [], [], "", False

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        self.inside = attributes.get("id") == "data"

    def handle_endtag(self, tag):
        self.inside = False

    def handle_data(self, data):
        if self.inside:
            self.data += data


class TestPage:
    @pytest.fixture(scope="class")
    @staticmethod
    def text(tmp_path_factory):
        path = tmp_path_factory.mktemp("page") / "toy.html"
        write_page([TABLE, TABLE], path)
        return path.read_text(encoding="utf-8")

    @pytest.fixture
    @staticmethod
    def loaded(text):
        found = Loaded()
        found.feed(text)
        return found

    def test_loads_nothing(self, loaded):
        assert loaded.links == []
        assert not {"link", "iframe", "img", "object", "base"} & set(loaded.tags)

    def test_holds_the_data_whatever_it_says(self, loaded):
        data, other = json.loads(loaded.data)
        assert data == other
        assert data["subject"]["title"] == SUBJECT.title
        assert len(data["rows"]) == len(PLAN)
        assert data["rows"][0]["cost"] == [3.0, 3.0, 6.0]

    @pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
    def test_script_finds_the_same_frontier(self, text, loaded, tmp_path):
        script = text[text.rindex("function chart(data, root) {") + 28 : text.rindex("build();")]
        (tmp_path / "data.json").write_text(loaded.data, encoding="utf-8")
        (tmp_path / "check.js").write_text(
            f"const [data] = JSON.parse(require('fs').readFileSync({str(tmp_path / 'data.json')!r}, 'utf8'));\n"
            + script.replace('"use strict";', "")
            + "\nconst rows = shownRows(subject.metrics[0]).filter((row) => row.settings.gain === 0.5);\n"
            "console.log(JSON.stringify(frontierOf(rows, subject.metrics[0]).map((row) => row.cost[0])));\n",
            encoding="utf-8",
        )
        said = subprocess.run(["node", tmp_path / "check.js"], check=True, capture_output=True, text=True).stdout
        assert json.loads(said) == [row.cost.value for row in TABLE.frontier(SUBJECT.metrics[0])]
