"""A host without our plug-in sees ordinary splats with typed extra attributes."""

import json
import os
import subprocess
import sys

import numpy as np

from beam_warp.schema.writer import write_asset
from beam_warp.world.harmonics import SH_C0

PROGRAM = """
import json, sys
import numpy as np
from pxr import Usd, UsdGeom, UsdVol
stage = Usd.Stage.Open(sys.argv[1])
prim = stage.GetPrimAtPath('/Asset/Splats')
splats = UsdVol.ParticleField3DGaussianSplat(prim)
value = lambda name, time=Usd.TimeCode.Default(): np.asarray(prim.GetAttribute(name).Get(time)).astype(float).tolist()
print(json.dumps({
    'has_api': prim.HasAPI('BeamRelightableGaussianAPI'),
    'is_splat': bool(splats),
    'types': {a.GetName(): str(a.GetTypeName()) for a in prim.GetAuthoredAttributes()},
    'version': prim.GetAttribute('beam:schemaVersion').Get(),
    'space': prim.GetAttribute('beam:baseColor').GetColorSpace(),
    'degree': splats.GetRadianceSphericalHarmonicsDegreeAttr().Get(),
    'harmonics': value('radiance:sphericalHarmonicsCoefficients'),
    'occlusion': value('beam:ambientOcclusion', 64),
    'extent': value('extent', 64),
    'up': str(UsdGeom.GetStageUpAxis(stage)), 'meters': UsdGeom.GetStageMetersPerUnit(stage),
    'seconds': (stage.GetEndTimeCode() - stage.GetStartTimeCode() + 1) / stage.GetTimeCodesPerSecond(),
}))
"""


def seen_by_plain_usd(source, path):
    """Write an asset; what a process without our plug-in sees of it."""
    write_asset(source, path, full_float=True)
    environment = {name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"}
    command = [sys.executable, "-c", PROGRAM, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stderr == ""
    return json.loads(done.stdout)


def test_opens_as_ordinary_splats(tmp_path, sequence):
    source = sequence(65)
    seen = seen_by_plain_usd(source, tmp_path / "a.usda")
    assert not seen["has_api"]
    assert seen["is_splat"]
    assert seen["types"]["beam:baseColor"] == "color3f[]"
    assert seen["types"]["beam:ambientOcclusion"] == "float[]"
    assert seen["types"]["beam:ids"] == "int64[]"
    assert (seen["version"], seen["space"], seen["up"], seen["meters"]) == ("1.1", "lin_rec709_scene", "Y", 1.0)
    assert seen["seconds"] == 65 / 24
    assert seen["degree"] == 1
    assert np.array_equal(np.float32(seen["harmonics"]), source[0].radiance.reshape(-1, 3))
    assert np.array_equal(np.float32(seen["occlusion"]), source[64].ambient_occlusion)
    assert (np.array(seen["extent"])[0] <= source[64].positions.min(axis=0)).all()


def test_stand_in_shows_the_base_colour(tmp_path, sequence):
    source = sequence(65, degree=None, ambient_occlusion=np.ones(6))
    seen = seen_by_plain_usd(source, tmp_path / "a.usda")
    shown = 0.5 + SH_C0 * np.array(seen["harmonics"])
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    assert seen["degree"] == 0
    assert np.abs(linear - source[0].base_color).max() < 1e-6  # float32 rounding of the coefficients
