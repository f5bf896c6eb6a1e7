"""No command writes over what it reads, layers included."""

import numpy as np
import pytest
from hostile import corpus
from support.commands import beam

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.world.gaussians import GaussianCloud


def test_a_render_does_not_replace_its_light(tmp_path, capsys):
    asset, light = corpus.ply(tmp_path), corpus.exr(tmp_path)
    before = light.read_bytes()
    (tmp_path / "inner").mkdir()
    for out in (light, tmp_path / "inner" / ".." / light.name):
        assert beam("render", asset, "--environment", light, "--out", out, "--width", 8, "--device", "cpu") == 2
        assert "error: --out must be another file than those that are read" in capsys.readouterr().err
    assert light.read_bytes() == before


@pytest.mark.parametrize("axes", ["abc", None, "rf", "rru", ["r", "f", "u"], "RFU"])
def test_axes_are_a_code(axes):
    fields = {"positions": np.zeros((1, 3)), "orientations": [[0, 0, 0, 1]], "scales": np.ones((1, 3))}
    fields["opacities"] = [1]
    with pytest.raises(InvalidOptionError, match="axes must name one of l/r, u/d and f/b each"):
        GaussianCloud(**fields, axes=axes)
    assert GaussianCloud(**fields, axes="lub").axes == "lub"


@pytest.mark.parametrize("value", [np.zeros((1, 3), complex), np.ma.masked_all((1, 3))])
def test_values_that_would_be_lost_are_refused(value):
    fields = {"orientations": [[0, 0, 0, 1]], "scales": np.ones((1, 3)), "opacities": [1]}
    with pytest.raises(InvalidArrayError, match="masked and complex arrays lose values"):
        GaussianCloud(positions=value, **fields)
