"""Two trees beside each other: which figures are rows, and which rows are apart."""

import json
import sys

import compare as benchmark
import pytest

pytestmark = pytest.mark.slow  # a benchmark's own tests


def result(median, spread, seconds=(1.0, 2.0, 6.0)):
    figure = {"median": median, "lowest": median - spread, "highest": median + spread, "unit": "ms"}
    return {"benchmark": "b", "cases": {"one": figure, "repeats": {"seconds": list(seconds)}}, "count": 3}


def test_rows_are_figures_with_a_range():
    rows = benchmark.compare([result(10.0, 1.0), result(12.0, 1.0)], [result(22.0, 1.0)])
    assert set(rows) == {"b, cases, one", "b, cases, repeats, seconds"}
    one = rows["b, cases, one"]
    assert one["before"] == {"medians": [10.0, 12.0], "lowest": 9.0, "highest": 13.0}
    assert (one["after_over_before"], one["apart"]) == (2.0, True)
    assert rows["b, cases, repeats, seconds"]["before"]["medians"] == [2.0, 2.0]


@pytest.mark.parametrize(("median", "is_apart"), [(12.0, False), (12.1, True), (7.9, True)])
def test_ranges_that_touch_are_not_apart(median, is_apart):
    rows = benchmark.compare([result(10.0, 1.0)], [result(median, 1.0)])
    assert rows["b, cases, one"]["apart"] == is_apart


def test_figures_of_one_tree_are_no_rows(tmp_path, monkeypatch, capsys):
    paths = [tmp_path / name for name in ("before.json", "after.json", "out.json")]
    before = result(10.0, 1.0)
    paths[0].write_text(json.dumps(before | {"lost": before["cases"]["one"]}))
    paths[1].write_text(json.dumps(result(20.0, 1.0)))
    words = ["--before", paths[0], "--after", paths[1], "--commits", "aaa", "bbb", "--out", paths[2]]
    monkeypatch.setattr(sys, "argv", ["compare.py", *map(str, words)])
    assert benchmark.main() == 0
    written = json.loads(paths[2].read_text())
    assert written["commits"] == {"before": "aaa", "after": "bbb"}
    assert len(written["rows"]) == 2
    assert "2 rows, the ranges of 1 apart" in capsys.readouterr().out
