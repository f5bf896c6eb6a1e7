"""The benchmark of flaws: which cases there are, what counts as named, units, and its table."""

import argparse
import json
from dataclasses import replace
from types import SimpleNamespace

import flaws as benchmark
import numpy as np
import pytest
import tables_flaws
from support.fake_steps import write_capture

from beam_warp.capture.capture import Capture
from beam_warp.capture.corrections import CameraCorrection, RigCorrection, moved_camera
from beam_warp.capture.findings import Finding
from beam_warp.stability.flaws.write import FLAWS
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import sh_basis

pytestmark = pytest.mark.slow  # a benchmark's own tests


def arguments(**changes):
    given = {"captures": ["a", "b"], "flaws": ["clean", "masks"], "sizes": [0.5, 2.0], "seeds": [0, 1]}
    return argparse.Namespace(**given, **changes)


def copy(**injected):
    records = [SimpleNamespace(camera_name=f"train_{k:02d}") for k in range(4)]
    nothing = {"cameras": {}, "light": {}, "missing": []}
    return SimpleNamespace(capture=SimpleNamespace(records=records), injected={**nothing, **injected})


def test_what_has_no_size_is_run_once_a_seed():
    found = list(benchmark.cases(arguments()))
    assert len(found) == len(set(found)) == 2 * 2 * (1 + 2)
    assert {size for _, name, size, _ in found if name == "clean"} == {1.0}


def test_names_stand_for_flaws():
    assert benchmark.flaws_of("clean") == ()
    assert set(benchmark.flaws_of("flawed")) == {"exposure", "noise", "masks", "poses", "light"}
    assert benchmark.flaws_of("masks+poses") == ("masks", "poses")


def test_several_flaws_have_a_row_of_few_words():
    scores = {name: {"psnr": 30.0, "ssim": 0.9} for name in (*tables_flaws.IMAGES, "roughness")}
    scores |= {"base_color_scale": 1.0, "normals_median_degrees": 2.0, "depth_median_mm": 3.0}
    cases = [("walker", "masks"), ("walker", "noise+masks+poses")]
    rows = [
        {"case": {"capture": capture, "flaw": flaw, "size": 1.0}, "scores": scores, "named": {}, "beside": []}
        for capture, flaw in cases
    ]
    labels = [row[0] for row in tables_flaws.scores(rows)[1:]]
    assert labels == [FLAWS["masks"], "noise, masks and poses at once"]


@pytest.mark.parametrize(
    ("name", "code", "where", "named", "beside"),
    [
        ("exposure", "camera-exposure", "train_01 +0.4", True, []),
        ("masks", "camera-exposure", "train_01 +0.4", False, ["camera-exposure of train_01"]),
        ("wrong-camera", "sees-nothing", "train_02", True, []),
        ("wrong-camera", "sees-nothing", "train_03", False, ["sees-nothing of train_03"]),
        ("light", "environment-turned", "", True, []),
    ],
)
def test_a_flaw_is_named_by_its_code_and_its_camera(name, code, where, named, beside):
    case = copy(cameras={"train_02": {"turn_degrees": 20.0}})
    said = benchmark.told(case, name, [Finding("warning", code, "something", where), Finding("note", "assumed", "")])
    assert said["named"] == {name: named}
    assert list(said["beside"]) == beside


def test_colors_in_units_of_white_are_those_of_the_clean_capture(rng):
    cloud = GaussianCloud(
        positions=rng.normal(size=(5, 3)).astype(np.float32),
        orientations=np.tile(np.float32([0, 0, 0, 1]), (5, 1)),
        scales=np.full((5, 3), 0.01, np.float32),
        opacities=np.ones(5, np.float32),
        radiance=rng.normal(size=(5, 4, 3)).astype(np.float32),
        radiance_color_space="lin_rec709_scene",
    )
    directions = rng.normal(size=(7, 3))
    basis = sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), 1)
    sequence = GaussianSequence.from_clouds([cloud])
    before, after = (
        0.5 + np.einsum("dk,nkc->ndc", basis, made[0].radiance)
        for made in (sequence, benchmark.in_units_of(sequence, 1.6))
    )
    np.testing.assert_allclose(after, 1.6 * before, atol=1e-5)


def test_poses_are_compared_but_for_a_motion_of_the_world(tmp_path, rng):
    capture = Capture.read(write_capture(tmp_path / "ball", (0,), cameras=8))
    surface = rng.uniform(-0.5, 0.5, (400, 3))
    world = np.eye(4)
    world[:3, 3] = [2e-3, 0.0, -1e-3]
    shaken = []
    for entry in capture.records:
        pose = world @ entry.camera.camera_to_world
        shaken.append(replace(entry, camera=replace(entry.camera, camera_to_world=pose)))
    turned = moved_camera(shaken[0].camera, [0.01, *[0.0] * 8])
    shaken[0] = replace(shaken[0], camera=turned)
    copy = Capture(**{**vars(capture), "records": tuple(shaken)})
    mend = RigCorrection((CameraCorrection("c0", turn=(-0.01, 0.0, 0.0)),), is_applied=True, confidence=9.0)
    found = benchmark.recovered_poses(capture, copy, mend, surface)
    assert found["pose_pixels_injected"] > 0.05
    assert found["pose_pixels"] < 1e-3
    assert found["pose_mm"] < 1e-2
    assert found["gauge_mm"] == pytest.approx(1e3 * np.hypot(2e-3, 1e-3), rel=1e-2)
    assert benchmark.recovered_poses(capture, copy, None, surface)["pose_mm"] == found["pose_mm_injected"]


def test_rows_of_other_code_are_not_continued(tmp_path):
    out = tmp_path / "flaws.json"
    assert benchmark.known_rows(argparse.Namespace(out=out)) == []
    out.write_text(json.dumps({"measured": {"code": {}}, "rows": [{"name": "one"}]}))
    assert benchmark.known_rows(argparse.Namespace(out=out)) == [{"name": "one"}]
    out.write_text(json.dumps({"measured": {"code": {"benchmarks/flaws.py": "0"}}, "rows": []}))
    with pytest.raises(SystemExit, match=r"measured by other code: benchmarks/flaws\.py"):
        benchmark.known_rows(argparse.Namespace(out=out))


def test_errors_of_gains_are_those_over_the_rig_s():
    """A factor that all cameras share is none; a stop too much in one of two is half a stop in each."""
    injected = {"a": {"exposure_stops": 1.0, "white_balance": [0.25, 0.0]}}
    balance = np.log([1.25, 1.0, 1.0]) - np.log(1.25) / 3.0
    stops = 1.0 + np.log2(1.25) / 3.0
    right = {"camera": "a", "stops": stops, "balance": balance, "gains": 4.0 * np.array([2.5, 2.0, 2.0])}
    cameras = [right, {"camera": "b", "stops": 0.0, "balance": [0.0] * 3, "gains": [4.0] * 3}]
    assert benchmark.gain_errors(injected, cameras) == pytest.approx(dict.fromkeys(NAMES, 0.0), abs=1e-12)
    cameras[1]["stops"] = 1.0
    found = benchmark.gain_errors(injected, cameras)
    assert found["exposure_found"] == pytest.approx(0.5 * np.log(2.0))
    assert found["white_balance_found"] == pytest.approx(0.0, abs=1e-12)


NAMES = ("exposure_found", "white_balance_found", "exposure_error", "white_balance_error")


def test_the_table_has_the_clean_capture_first_and_then_the_worst():
    def row(flaw, level, seed=0, **more):
        score = {"psnr": level, "ssim": 0.9}
        images = dict.fromkeys((*tables_flaws.IMAGES, "roughness"), score)
        numbers = {"base_color_scale": [1.0] * 3, "normals_median_degrees": 2.0, "depth_median_mm": 1.0}
        case = {"capture": "walker", "flaw": flaw, "size": 1.0, "seed": seed}
        stops = {"light_stops": 0.5, "light_stops_injected": 0.25}
        found = {**stops, "exposure_spread": 0.1, "exposure_spread_injected": 0.2}
        found |= {"falloff": 3.9, "falloff_injected": 4.0}
        errors = {key: {"within_1": 0.6, "within_2": 0.9} for key in ("base_color", "base_color_scaled", "roughness")}
        said = {"recovered": found, "errors": errors, "seconds": {"run": 7.0}, "named": {}, "beside": [], **more}
        return {"case": case, "scores": {**images, **numbers}, **said}

    rows = [row("noise", 29.0), row("clean", 30.0, beside=["few-cameras in frame 0"])]
    rows += [row("masks", 20.0 + 2 * seed, seed, named={"masks": bool(seed)}) for seed in (0, 1)]
    head, *body = tables_flaws.scores(rows)
    assert {len(cells) for cells in body} == {len(head)}
    assert [cells[1] for cells in body] == ["30.0 dB / 0.900", "21.0 dB / 0.900", "29.0 dB / 0.900"]
    assert [cells[-1] for cells in body] == ["also `few-cameras`", "masks in 1 of 2 runs", ""]
    together = {"rows": [row("clean", 31.0), row("flawed", 25.0)]}
    _, *alone = tables_flaws.alone(together, {"rows": [row("vignetting", 28.0)]}, {"rows": [row("noise", 29.0)]})
    assert [cells[1] for cells in alone] == ["31.0 dB / 0.900", "28.0 dB / 0.900", "29.0 dB / 0.900"]
    _, *others = tables_flaws.others({"rows": [*rows, row("flawed", 25.0)]}, {"rows": [row("noise", 29.0)]})
    assert [cells[1] for cells in others] == ["30.0 dB / 0.900", "21.0 dB / 0.900"]
    _, first, *_, last = tables_flaws.recovered({"rows": rows}, {"rows": [row("vignetting", 32.0)]})
    assert last[0].startswith("all images darkened")
    assert first == ["nothing", "+0.50", "-0.25", "0.10", "0.20", "3.9", "4.0", *["60 %, 90 %"] * 3, "7"]


def test_what_was_refused_has_a_row():
    case = {"capture": "walker", "flaw": "masks", "size": 2.0, "seed": 0}
    rows = [{"case": case, "refused": "no", "named": {"masks": False}, "beside": []}]
    for head, cells in (tables_flaws.scores(rows), tables_flaws.recovered({"rows": rows}, {"rows": []})):
        assert len(cells) == len(head)
        assert cells[0].endswith("twice that")


def test_a_case_is_made_scored_and_continued(tiny_capture, tmp_path):
    asked = argparse.Namespace(frames=1, gaussians=300, preset="draft", device="cpu", naming=None)
    row = benchmark.measure(tiny_capture, "noise", 1.0, 0, asked, tmp_path)
    assert row["gaussians"] <= 300
    assert set(row["named"]) == {"noise"}
    assert row["scores"]["novel_view"]["psnr"] > 15.0  # in the clean capture's units, or it would be dim
    assert 0.0 < row["errors"]["base_color"]["within_1"] <= row["errors"]["base_color"]["within_2"] <= 1.0
    assert row["recovered"]["light_stops_injected"] == 0.0
    json.dumps(row)


def test_a_case_is_named_without_materials_at_half_the_resolution(tiny_capture, tmp_path):
    asked = argparse.Namespace(frames=1, gaussians=300, preset="draft", device="cpu")
    small = benchmark.reduced(tiny_capture, 2)
    record, whole = small.records[0], tiny_capture.records[0]
    assert record.view().camera.width == record.camera.width == whole.camera.width // 2
    np.testing.assert_array_equal(record.view().color, whole.view().reduced(2).color)
    for asked.naming in ("images", "rig", "all"):
        (tmp_path / asked.naming).mkdir()
        row = benchmark.measure(small, "jpeg", 2.0, 0, asked, tmp_path / asked.naming)
        assert row["named"] == {"jpeg": True}
        assert "scores" not in row
    assert "jpeg-loss" in benchmark.in_a_line(row)
    head, cells = tables_flaws.named({"rows": [{"case": {"capture": "a", "flaw": "jpeg", "size": 2.0}, **row}]})
    assert (len(head), cells[1].split(",")[0]) == (len(cells), "jpeg")
