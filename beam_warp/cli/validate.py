"""``beam-validate``: does an asset keep the rules of the schema, and those of OpenUSD and of physics?"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from beam_warp._version import __version__
from beam_warp.cli.common.console import escaped, print_json, progress, run_command
from beam_warp.errors import InvalidOptionError

if TYPE_CHECKING:
    from beam_warp.evaluate.physical_rules import Measured
    from beam_warp.schema.validation.report import Report

_EPILOG = """\
exit code: 0 valid (warnings allowed), 1 a rule of severity error is broken, 2 the file cannot be read

example:
  beam-validate dancer.usda
  beam-validate dancer.usda --fix
  beam-validate dancer.usda --physical --sarif dancer.sarif
  beam-validate dancer.usdz --json | jq '.findings[].rule'
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(
        prog="beam-validate",
        description="Check a relightable 4D Gaussian asset (.usd, .usda, .usdc, .usdz).",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("asset", nargs="?", help="the file to check, or the folder of an asset")
    parser.add_argument("--fix", action="store_true", help="mend in place what is safe to mend, then check")
    parser.add_argument("--physical", action="store_true", help="also trace the asset and judge it by physics (slower)")
    parser.add_argument("--device", help="cpu, cuda:0, … for --physical; the first GPU by default, if there is one")
    parser.add_argument("--sarif", metavar="FILE", type=Path, help="also write the report as SARIF 2.1.0, for CI")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.add_argument("--quiet", action="store_true", help="print nothing; only the exit code answers")
    parser.add_argument("--rules", action="store_true", help="list every rule and stop")
    parser.add_argument("--version", action="version", version=f"beam-validate {__version__}")
    options = parser.parse_args(arguments)
    if options.rules:
        return run_command(lambda: _list_rules(options.json))
    if options.asset is None:
        parser.error("asset must be given, got none. Name a .usd, .usda, .usdc or .usdz file.")
    return run_command(lambda: _validate(options))


def _validate(options: argparse.Namespace) -> int:
    from beam_warp.converters.numbering import files_at
    from beam_warp.schema.validation.mending import mend
    from beam_warp.schema.validation.sarif import write_sarif
    from beam_warp.schema.validation.validator import validate

    options.asset = str(files_at(Path(options.asset))[0])
    if options.sarif is not None and options.sarif.suffix not in (".sarif", ".json"):
        raise InvalidOptionError(f"--sarif must name a .sarif or .json file, got {options.sarif}. Choose another name.")
    report = mend(options.asset) if options.fix else validate(options.asset)
    measured: list[Measured] = []
    if options.physical:
        report, measured = _with_physics(report, options)
    if options.sarif is not None:
        write_sarif(report, {rule["id"]: rule["text"] for rule in _rules()}, options.sarif)
    if options.json and not options.quiet:
        print_json({**report.as_dict(), "physical": [asdict(each) for each in measured]})
    elif not options.quiet:
        _say(options.asset, report, measured)
    return 0 if report.is_valid else 1


def _with_physics(report: Report, options: argparse.Namespace) -> tuple[Report, list[Measured]]:
    """Measure an asset that keeps all other rules, and add the rules of physics that it breaks to its report."""
    if not report.is_valid:
        raise InvalidOptionError(
            f"--physical must be given a valid asset, got one that breaks {report.findings[0].rule}. "
            "Mend what beam-validate reports without it first."
        )
    from beam_warp.evaluate.physical import measure_physics
    from beam_warp.evaluate.physical_rules import broken
    from beam_warp.schema.reader import read_asset

    with progress(options.quiet or options.json) as listener:
        measured = measure_physics(read_asset(options.asset, trusted=True), device=options.device, progress=listener)
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
