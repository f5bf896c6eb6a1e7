"""Numbers on pages are those of results, and a result says when its code has changed."""

import json
import re

import pytest
import record
import tables

HEAD = {
    "program": "benchmarks/thing.py",
    "options": {"quick": True, "parts": ["a", "b"]},
    "commit": "abc1234",
    "date": "2026-01-31",
    "machine": {"device": "NVIDIA H200", "cores": 16},
    "code": {},
}
THING = {
    "rows": [{"name": "First row", "ms": {"median": 1.234, "lowest": 1.2, "highest": 1.5}}, {"name": "other", "ms": 2}],
    "speed": {"RGB, forwards": 1_150_300_000.0},
}
SOURCE = "NVIDIA H200, commit abc1234, 2026-01-31, quick, parts a b"


@pytest.fixture
def thing(tmp_path, monkeypatch):
    """A repository with one result, and a table and a number of it."""
    results = tmp_path / "benchmarks" / "results"
    results.mkdir(parents=True)
    (results / "thing.json").write_text(json.dumps({"measured": HEAD, **THING}))
    monkeypatch.setattr(record, "ROOT", tmp_path)
    monkeypatch.setattr(record, "RESULTS", results)
    monkeypatch.setattr(
        tables, "TABLES", {"things": (("thing.json",), lambda r: [["", "ms"], ["x", r["rows"][0]["ms"]]])}
    )
    monkeypatch.setattr(tables, "NUMBERS", {"twice": (("thing.json",), lambda r: 2 * r["rows"][1]["ms"])})
    tables.result.cache_clear()
    yield tmp_path / "docs" / "page.md"
    tables.result.cache_clear()


class TestPages:
    def test_a_table_is_written_between_its_markers_with_its_source(self, thing):
        text = tables.filled(thing, "before\n\n<!-- table things -->\nold\n<!-- /table -->\n\nafter\n")
        assert "| x | 1.23 (1.2–1.5) |" in text
        assert f"*Source: [thing.json](../benchmarks/results/thing.json), {SOURCE}.*" in text
        assert "old" not in text
        assert text.startswith("before\n")
        assert text.endswith("after\n")
        assert tables.filled(thing, text) == text

    @pytest.mark.parametrize(
        ("key", "said"),
        [
            ("rows/first_row/ms~.2f", "1.23"),
            ("rows/1/ms", "2"),
            ("speed/rgb_forwards~*1e-9:.2f", "1.15"),
            ("=twice~.1f", "4.0"),
        ],
    )
    def test_a_number_in_a_sentence_says_its_source_on_hover(self, thing, key, said):
        text = tables.filled(thing, f"It takes [](../benchmarks/results/thing.json#{key}) ms.")
        assert f'[{said}](../benchmarks/results/thing.json#{key} "{SOURCE}' in text
        assert tables.filled(thing, text) == text

    def test_repeats_have_their_range_on_hover(self, thing):
        text = tables.filled(thing, "[](../benchmarks/results/thing.json#rows/first_row/ms~.1f)")
        assert text.endswith('median of repeats, which range from 1.2 to 1.5")')

    @pytest.mark.parametrize("key", ["rows/nobody/ms", "missing", "=nothing"])
    def test_a_key_that_leads_nowhere_is_an_error(self, thing, key):
        with pytest.raises(KeyError):
            tables.filled(thing, f"[1](../benchmarks/results/thing.json#{key})")

    def test_a_result_that_does_not_say_how_it_was_measured_is_refused(self, thing):
        (record.RESULTS / "bare.json").write_text("{}")
        with pytest.raises(ValueError, match="how it was measured"):
            tables.result("bare.json")


class TestStaleness:
    def test_code_counts_but_not_what_is_said_about_it(self):
        plain = "def f(x):\n    return x + 1\n"
        said = '"""Module."""\n\n\ndef f(x):\n    """Add."""\n    return x + 1  # one\n'
        assert record.code_digest(plain) == record.code_digest(said)
        assert record.code_digest(plain) != record.code_digest(plain.replace("1", "2"))

    def test_a_changed_file_and_one_that_is_gone_are_named(self, thing):
        path = record.ROOT / "kept.py"
        path.write_text("x = 1\n")
        code = {"kept.py": record.code_digest("x = 1\n"), "gone.py": "0" * 12}
        record._digest_of_file.cache_clear()
        assert record.changed_since({"code": code}) == ["gone.py"]
        path.write_text("x = 2\n")
        record._digest_of_file.cache_clear()
        assert record.changed_since({"code": code}) == ["kept.py", "gone.py"]
        assert record.changed_since({"code": {}}) == []
        inside = {f"somewhere/{place}": digest for place, digest in code.items()}
        assert record.changed_since({"code": record.by_folder(inside)}) == list(inside)
        assert record.by_folder({"a/b.py": "1", "a/c.py": "2"}) == {"a": "b:1 c:2"}

    def test_loaded_code_has_paths_of_the_repository(self):
        import beam_warp.world.camera  # noqa: F401

        found = record.loaded_code()
        assert "beam_warp/world/camera.py" in found
        assert "benchmarks/tables.py" in found
        assert all((record.ROOT / place).is_file() for place in found)
        assert not any(place.startswith(("beam_warp/kernels/", "beam_warp/errors")) for place in found)


def test_tables_of_the_package_itself_are_on_their_pages():
    """Formats and importers are no results: their tables come from the package, and nothing is measured for them."""
    tables.load_tables()
    shown = {}
    for page in tables.pages():
        text = page.read_text("utf-8")
        new = {match["name"]: match[0] for match in tables.TABLE.finditer(tables.filled(page, text))}
        for match in tables.TABLE.finditer(text):
            if not tables.TABLES[match["name"]][0]:
                shown[page.name, match["name"]] = match[0] == new[match["name"]]
    assert shown == {("formats.md", "formats"): True, ("engines.md", "importers"): True}


def test_every_page_is_as_the_results_say():
    """Run ``python benchmarks/tables.py`` where this fails."""
    tables.load_tables()
    changed = [page.name for page in tables.pages() if tables.filled(page, (text := page.read_text("utf-8"))) != text]
    assert not changed
    for name, (files, _) in tables.FIGURES.items():
        assert tables.drawn_from(record.ROOT / "docs" / "images" / name) == tables.figure_source(files), name


MEASURED = re.compile(
    r"\d\s*(dB|FPS|Mray|ms\b|GiB|million (rays|samples)|G rays)|\d(\.\d+)? ?× faster|\d times (as fast|faster)"
)
"""Units that only measurements have."""

DEFINED = (
    "Equal images have 120 dB",
    "3 to 5 dB below PSNR (10 log10 of two to three)",
    "doubling gains less than 0.15 dB",
    "tracked frames more than 3 dB below",
    "if the last frame is more than 3 dB worse than the first",
    "uncompressed, 64-byte aligned, below 4 GiB",
    "PSNR is more than 6 dB below that of the key frame, which counts as at most 44 dB",
    "met more than 6 dB worse",
    "Without, q is taken to be 35 dB, that of a good asset: within 0.3 dB then means",
    "46.5 dB against the original; within 1 dB, 40.9 dB",
    "fails below 40 dB",
    "for the demo's figure below 38 dB",
)
"""Thresholds and closed forms in such units: nothing was measured."""


def test_no_measured_number_is_typed_by_hand():
    """Outside of generated tables, numbers with a measurement's unit are links to their results."""
    typed = {}
    for page in tables.pages():
        text = tables.TABLE.sub("", page.read_text("utf-8"))
        text = re.sub(r"```.*?```", "", tables.NUMBER.sub("", text), flags=re.DOTALL)
        for words in DEFINED:
            text = text.replace(words, "")
        typed[page.name] = [line for line in text.splitlines() if MEASURED.search(line)]
    assert not {name: lines for name, lines in typed.items() if lines}
