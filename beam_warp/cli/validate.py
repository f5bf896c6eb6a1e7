"""``beam-validate``: does an asset keep the rules of the schema, and those of OpenUSD and of physics?"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from beam_warp._version import __version__
from beam_warp.cli.common.console import escaped, options_named, print_json, progress, run_command
from beam_warp.cli.common.flags import Json, Quiet
from beam_warp.cli.common.pages import parse
from beam_warp.cli.common.paths import paths_checked
from beam_warp.errors import InvalidOptionError

if TYPE_CHECKING:
    from beam_warp.evaluate.physical_rules import Measured
    from beam_warp.schema.validation.report import Report


@dataclass(frozen=True)
class Validate:
    """Check a relightable 4D Gaussian asset against the rules of its schema, and by the validators of OpenUSD.

    Example: beam-validate dancer.usda --fix

    The exit code is 0 for a valid asset, warnings allowed; 1 if a rule of severity error is broken; 2 if the file
    cannot be read. For programs: beam-validate dancer.usdz --json | jq '.findings[].rule'. `beam-validate --version`
    prints the version.
    """

    asset: Annotated[
        Positional[Path | None],
        arg(metavar="ASSET", help="File to check (.usd, .usda, .usdc, .usdz), or the folder of an asset."),
    ] = None
    fix: Annotated[bool, arg(help="Mend in place what is safe to mend, then check.")] = False
    physical: Annotated[bool, arg(help="Also trace the asset and judge it by physics, which is slower.")] = False
    original: Annotated[
        Path | None, arg(metavar="ASSET", help="What it was reduced from: --physical repeats its certificate.")
    ] = None
    environment: Annotated[
        tuple[Path, ...], arg(metavar="FILE ...", help="The lights that `beam reduce` was given, if any.")
    ] = ()
    device: Annotated[
        str | None, arg(help="cpu, cuda:0, … for --physical; the first GPU by default, if there is one.")
    ] = None
    sarif: Annotated[Path | None, arg(metavar="FILE", help="Also write the report as SARIF 2.1.0, for CI.")] = None
    rules: Annotated[bool, arg(help="List every rule and stop.")] = False
    quiet: Quiet = False
    json: Json = False


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``beam-validate``; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"beam-validate {__version__}")
        return 0
    command = parse(Validate, words, "beam-validate")
    return run_command(lambda: _list_rules(command.json) if command.rules else _checked(command))


def _checked(command: Validate) -> int:
    with paths_checked(command):
        return validate(command)


@options_named(Validate)
def validate(command: Validate) -> int:
    """Check an asset, mending it first if that is asked for, and say what was found."""
    from beam_warp.converters.numbering import files_at
    from beam_warp.schema.validation import validator
    from beam_warp.schema.validation.mending import mend
    from beam_warp.schema.validation.sarif import write_sarif

    if command.asset is None:
        raise InvalidOptionError("asset must be given, got none. Name a .usd, .usda, .usdc or .usdz file.")
    if command.sarif is not None and command.sarif.suffix not in (".sarif", ".json"):
        raise InvalidOptionError(f"sarif must name a .sarif or .json file, got {command.sarif}. Choose another name.")
    asset = str(files_at(command.asset)[0])
    report = mend(asset) if command.fix else validator.validate(asset)
    measured: list[Measured] = []
    if command.physical:
        report, measured = _with_physics(asset, report, command)
    if command.sarif is not None:
        write_sarif(report, {rule["id"]: rule["text"] for rule in _rules()}, command.sarif)
    if command.json and not command.quiet:
        print_json({**report.as_dict(), "physical": [asdict(each) for each in measured]})
    elif not command.quiet:
        _say(asset, report, measured)
    return 0 if report.is_valid else 1


def _with_physics(asset: str, report: Report, command: Validate) -> tuple[Report, list[Measured]]:
    """Measure an asset that keeps all other rules, and add the rules of physics that it breaks to its report."""
    if not report.is_valid:
        raise InvalidOptionError(
            f"physical must be given a valid asset, got one that breaks {report.findings[0].rule}. "
            "Mend what beam-validate reports without it first."
        )
    from beam_warp import converters
    from beam_warp.demo.lights import demo_environments
    from beam_warp.evaluate.physical import measure_physics
    from beam_warp.evaluate.physical_rules import broken
    from beam_warp.schema.reader import read_asset
    from beam_warp.world.environment import EnvironmentMap

    with progress(command.quiet or command.json) as listener:
        measured = measure_physics(
            read_asset(asset, trusted=True),
            device=command.device,
            original=None if command.original is None else converters.read(command.original),
            environments=[EnvironmentMap.read(path) for path in command.environment] or [*demo_environments().values()],
            progress=listener,
        )
    findings = sorted((*report.findings, *broken(measured)), key=lambda found: found.severity)
    return replace(report, findings=tuple(findings)), measured


def _say(asset: str, report: Report, measured: Sequence[Measured]) -> None:
    """Print a report for people."""
    for finding in report.mended:
        print(escaped(f"mended  {str(finding).removeprefix(f'{finding.severity:7} ')}"))
    for finding in report.findings:
        print(escaped(str(finding)))
    for each in measured:
        print(each)
    errors = sum(finding.severity == "error" for finding in report.findings)
    counts = [(errors, "error"), (len(report.findings) - errors, "warning")]
    said = ", ".join(_plural(count, noun) for count, noun in counts)
    mended = f"; {len(report.mended)} mended" if report.mended else ""
    size = f"{_plural(report.frames, 'frame')}, {_plural(report.gaussians, 'Gaussian')}"
    print(f"{asset}: {'valid' if report.is_valid else 'not valid'} ({size}; {said}{mended})")


def _rules() -> list[dict[str, str]]:
    """Return id, severity and text of every rule, and what ``--fix`` does about it."""
    from beam_warp.evaluate.physical_rules import PHYSICAL_RULES
    from beam_warp.schema.validation.mends import mend_text
    from beam_warp.schema.validation.validator import ALL_RULES

    rules = sorted([*ALL_RULES, *PHYSICAL_RULES], key=lambda rule: rule.id)
    return [{"id": rule.id, "severity": rule.severity, "text": rule.text, "fix": mend_text(rule.id)} for rule in rules]


def _list_rules(as_json: bool) -> int:
    if as_json:
        print_json(_rules())
        return 0
    for rule in _rules():
        fix = f" --fix: {rule['fix']}" if rule["fix"] else ""
        print(f"{rule['id']:17} {rule['severity']:8} {rule['text']}{fix}")
    return 0


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


if __name__ == "__main__":
    raise SystemExit(main())
