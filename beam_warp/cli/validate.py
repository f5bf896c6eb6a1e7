"""``beam-validate``: does an asset keep the rules of the schema, and those of OpenUSD?"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from beam_warp._version import __version__
from beam_warp.cli.common.console import escaped, print_json, run_command

_EPILOG = """\
exit code: 0 valid (warnings allowed), 1 a rule of severity error is broken, 2 the file cannot be read

example:
  beam-validate dancer.usda
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
    parser.add_argument("asset", nargs="?", help="the file to check")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.add_argument("--quiet", action="store_true", help="print nothing; only the exit code answers")
    parser.add_argument("--rules", action="store_true", help="list every rule and stop")
    parser.add_argument("--version", action="version", version=f"beam-validate {__version__}")
    options = parser.parse_args(arguments)
    if options.rules:
        return run_command(lambda: _list_rules(options.json))
    if options.asset is None:
        parser.error("asset must be given, got none. Name a .usd, .usda, .usdc or .usdz file.")
    return run_command(lambda: _validate(options.asset, options.json, options.quiet))


def _validate(asset: str, as_json: bool, quiet: bool) -> int:
    from beam_warp.schema.validator import validate

    report = validate(asset)
    if as_json and not quiet:
        print_json(report.as_dict())
    elif not quiet:
        for finding in report.findings:
            print(escaped(str(finding)))
        errors = sum(finding.severity == "error" for finding in report.findings)
        warnings = len(report.findings) - errors
        size = f"{_plural(report.frames, 'frame')}, {_plural(report.gaussians, 'Gaussian')}"
        verdict = "valid" if report.is_valid else "not valid"
        print(f"{asset}: {verdict} ({size}; {_plural(errors, 'error')}, {_plural(warnings, 'warning')})")
    return 0 if report.is_valid else 1


def _list_rules(as_json: bool) -> int:
    from beam_warp.schema.validator import ALL_RULES

    if as_json:
        print_json([{"id": rule.id, "severity": rule.severity, "text": rule.text} for rule in ALL_RULES])
    else:
        for rule in ALL_RULES:
            print(f"{rule.id:17} {rule.severity:8} {rule.text}")
    return 0


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


if __name__ == "__main__":
    raise SystemExit(main())
