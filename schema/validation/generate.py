"""Generator of generatedSchema.usda and plugInfo.json: ``python -m beam_warp.schema.validation.generate``.

It runs usdGenSchema, a part of usd-core, which needs jinja2 (the ``dev`` extra). A test generates the files and
compares them, so that the three files cannot drift apart.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from beam_warp.errors import OutputError
from beam_warp.schema import PLUGIN_FOLDER
from beam_warp.schema.validation.frame_rules import FRAME_RULES
from beam_warp.schema.validation.rules import STAGE_RULES
from beam_warp.schema.validation.validator import ALL_RULES, HOST_PLUGIN

GENERATED = ("generatedSchema.usda", "plugInfo.json")

# The plug-in lives in one flat folder of the Python package and has no compiled library.
_PLACES = {"@PLUG_INFO_LIBRARY_PATH@": "", "@PLUG_INFO_RESOURCE_PATH@": ".", "@PLUG_INFO_ROOT@": "."}


def _validator_plugin() -> dict[str, Any]:
    """Return the entry of plugInfo.json by which other hosts run our rules; OpenUSD imports the module on first use."""
    validators: dict[str, Any] = {"keywords": ["BeamValidators"]}
    for rule in ALL_RULES:
        validators[rule.id] = {"doc": rule.text}
        if rule not in STAGE_RULES:
            validators[rule.id] |= {"schemaTypes": ["UsdVolParticleField3DGaussianSplat"]}
        if rule in FRAME_RULES:
            validators[rule.id] |= {"isTimeDependent": True}
    validators["AssetRules"] = {"doc": "All rules of the beam schema.", "isSuite": True}
    return {
        "Info": {"Validators": validators},
        "Name": HOST_PLUGIN,
        "ResourcePath": ".",
        "Root": "host_validator.py",  # OpenUSD tells plug-ins apart by this path
        "Type": "python",
    }


def generate(folder: Path) -> None:
    """Write the generated files of schema.usda into ``folder``.

    Raises:
        OutputError: usdGenSchema failed; its output is in the message.
    """
    import pxr.Usd

    tool = Path(pxr.Usd.__file__).parent / "usdGenSchema.py"
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, str(tool), str(PLUGIN_FOLDER / "schema.usda"), scratch]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        made = [Path(scratch) / name for name in GENERATED]
        if done.returncode or not all(path.is_file() for path in made):
            raise OutputError(
                f"usdGenSchema must generate the schema, got exit code {done.returncode}. Install the dev extra "
                f"(jinja2) and mend schema.usda:\n{done.stdout}{done.stderr}"
            )
        # usdGenSchema leaves blanks before line ends and at the end of its files.
        layer, info = (
            "\n".join(line.rstrip() for line in path.read_text("utf-8").strip().splitlines()) for path in made
        )
    for placeholder, value in _PLACES.items():
        info = info.replace(placeholder, value)
    comment, _, body = info.partition("\n{")
    plugins = json.loads("{" + body)
    plugins["Plugins"].append(_validator_plugin())
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "generatedSchema.usda").write_text(layer + "\n", encoding="utf-8")
    (folder / "plugInfo.json").write_text(f"{comment}\n{json.dumps(plugins, indent=4)}\n", encoding="utf-8")


def main() -> None:
    """Run the generator from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--output", type=Path, default=PLUGIN_FOLDER, help="folder of the generated files")
    generate(parser.parse_args().output)


if __name__ == "__main__":
    main()
