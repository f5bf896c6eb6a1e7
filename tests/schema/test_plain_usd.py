"""A host without our plug-in sees ordinary splats with typed extra attributes."""

import json
import os
import subprocess
import sys

import numpy as np

from beam_warp.schema.writer import write_asset

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


def test_opens_as_ordinary_splats(tmp_path, sequence):
    source = sequence(65)
    write_asset(source, tmp_path / "a.usda", full_float=True)
    environment = {name: value for name, value in os.environ.items() if name != "PXR_PLUGINPATH_NAME"}
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "a.usda")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stderr == ""
    seen = json.loads(done.stdout)
    assert not seen["has_api"]
    assert seen["is_splat"]
    assert seen["types"]["beam:baseColor"] == "color3f[]"
    assert seen["types"]["beam:ambientOcclusion"] == "float[]"
    assert seen["types"]["beam:ids"] == "int64[]"
    assert (seen["version"], seen["space"], seen["up"], seen["meters"]) == ("1.3", "lin_rec709_scene", "Y", 1.0)
    assert seen["seconds"] == 65 / 24
    assert seen["degree"] == 1
    assert np.array_equal(np.float32(seen["harmonics"]), source[0].radiance.reshape(-1, 3))
    assert np.array_equal(np.float32(seen["occlusion"]), source[64].ambient_occlusion)
    assert (np.array(seen["extent"])[0] <= source[64].positions.min(axis=0)).all()
