"""Our rules as validators of OpenUSD, which finds them in plugInfo.json and imports this module on first use.

There is one validator for each rule, named after it, and one suite of all. An error has the name of its rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from pxr import Usd, UsdValidation

from beam_warp.schema.stage_queries import has_whole_clips
from beam_warp.schema.validation.frame_rules import FRAME_RULES
from beam_warp.schema.validation.report import BrokenRule
from beam_warp.schema.validation.rules import FIRST_RULES, STAGE_RULES, Rule
from beam_warp.schema.validation.validator import ALL_RULES, HOST_PLUGIN, ask, check_frames

_KINDS = {"error": UsdValidation.ValidationErrorType.Error, "warning": UsdValidation.ValidationErrorType.Warn}

Errors = list[UsdValidation.ValidationError]


def _stage_check(rule: Rule) -> Callable[[Usd.Stage, UsdValidation.ValidationTimeRange], Errors]:
    return lambda stage, _: _errors(stage, ask(rule, stage, "/"))


def _prim_check(rule: Rule) -> Callable[[Usd.Prim, UsdValidation.ValidationTimeRange], Errors]:
    def check(prim: Usd.Prim, times: UsdValidation.ValidationTimeRange) -> Errors:
        if rule not in FIRST_RULES and not has_whole_clips(prim):
            return []
        if rule in FRAME_RULES:
            return _errors(prim.GetStage(), check_frames(prim, [rule], times.GetInterval())[0])
        return _errors(prim.GetStage(), ask(rule, prim, str(prim.GetPath())))

    return check


def _errors(stage: Usd.Stage, findings: Iterable[BrokenRule]) -> Errors:
    return [
        UsdValidation.ValidationError(
            found.rule, _KINDS[found.severity], [UsdValidation.ValidationErrorSite(stage, found.prim)], found.message
        )
        for found in findings
    ]


def _register() -> None:
    registry = UsdValidation.ValidationRegistry()
    names = [f"{HOST_PLUGIN}:{rule.id}" for rule in ALL_RULES]
    for rule, name in zip(ALL_RULES, names, strict=True):
        if rule in STAGE_RULES:
            registry.RegisterPluginStageValidator(name, _stage_check(rule))
        else:
            registry.RegisterPluginPrimValidator(name, _prim_check(rule))
    suite = registry.GetOrLoadValidatorsByName(names)
    registry.RegisterPluginValidatorSuite(f"{HOST_PLUGIN}:AssetRules", suite)


_register()
