"""Perceptual differences: where their packages are, and what is said where they are not; nothing is ever fetched."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from beam_warp.evaluate.perceptual import LPIPS_SIDE, PerceptualMetrics, checkpoint_folder


def pretend_lpips(monkeypatch):
    """Packages that would download when a network is made, as the real ones do; return what networks are made of."""
    made = []
    models = ModuleType("torchvision.models")
    url = "https://example.org/models/alexnet-0123.pth"
    models.AlexNet_Weights = SimpleNamespace(IMAGENET1K_V1=SimpleNamespace(url=url))
    lpips = ModuleType("lpips")

    class Network:
        def __init__(self, **words):
            made.append(words)

        def __call__(self, a, b):
            return np.abs(a - b).mean()

    lpips.LPIPS, lpips.im2tensor = Network, lambda image: image / 127.5 - 1.0
    monkeypatch.setitem(sys.modules, "torchvision", ModuleType("torchvision"))
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    monkeypatch.setitem(sys.modules, "lpips", lpips)
    return made


def test_what_is_not_installed_is_named_with_its_extra(monkeypatch):
    for name in ("flip_evaluator", "lpips"):
        monkeypatch.setitem(sys.modules, name, None)  # importing it raises ImportError
    found = PerceptualMetrics.installed()
    assert found.measures == {}
    assert found.absent["flip"].endswith("pip install 'beam-warp[evaluate]'")
    assert found.absent["lpips"].endswith("pip install 'beam-warp[lpips]'")
    assert found.differences(np.zeros((4, 4)), np.ones((4, 4))) == {}


def test_lpips_without_weights_makes_no_network(monkeypatch, tmp_path):
    made = pretend_lpips(monkeypatch)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    found = PerceptualMetrics.installed()
    assert str(tmp_path / "hub" / "checkpoints" / "alexnet-0123.pth") in found.absent["lpips"]
    assert made == []


def test_lpips_with_weights(monkeypatch, tmp_path):
    made = pretend_lpips(monkeypatch)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    checkpoint_folder().mkdir(parents=True)
    (checkpoint_folder() / "alexnet-0123.pth").write_bytes(b"weights")
    found = PerceptualMetrics.installed()
    assert [words["net"] for words in made] == ["alex"]
    large, small = ((side, side + 2) for side in (LPIPS_SIDE, LPIPS_SIDE - 1))
    # 0.25 of [0, 1] is 0.5 of [-1, 1], which the network takes; too small an image has no difference.
    assert found.differences(np.full(large, 0.5), np.full(large, 0.75))["lpips"] == pytest.approx(0.5)
    assert "lpips" not in found.differences(np.zeros(small), np.zeros(small))


def test_an_old_torchvision_is_said(monkeypatch):
    pretend_lpips(monkeypatch)
    monkeypatch.setitem(sys.modules, "torchvision.models", ModuleType("torchvision.models"))
    assert "torchvision 0.13 or newer" in PerceptualMetrics.installed().absent["lpips"]


def test_the_folder_of_checkpoints_is_torchs(monkeypatch):
    monkeypatch.delenv("TORCH_HOME", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", "/cache")
    assert checkpoint_folder().as_posix() == "/cache/torch/hub/checkpoints"


def test_flip_of_equal_and_of_opposite_images(rng):
    pytest.importorskip("flip_evaluator", reason="flip-evaluator is not installed")
    measure = PerceptualMetrics.installed()
    image = rng.random((40, 30, 3))
    assert measure.differences(image, image)["flip"] == 0.0
    black, white = np.zeros((40, 30)), np.full((40, 30), 7.0)  # cut to 1
    # Black against white is the largest difference; inside both, where there is no edge, FLIP is 1 by its definition.
    assert measure.differences(black, white)["flip"] == pytest.approx(1.0, abs=0.05)
    slightly = [measure.differences(image, np.clip(image + step, 0, 1))["flip"] for step in (0.02, 0.2)]
    assert 0.0 < slightly[0] < slightly[1] < 1.0
