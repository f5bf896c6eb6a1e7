"""Our rules as an OpenUSD validator, which OpenUSD finds in plugInfo.json and imports when a host asks for it."""

from __future__ import annotations

from pxr import Usd, UsdValidation

from beam_warp.schema.validator import HOST_VALIDATOR, check_rules


def _asset_rules(stage: Usd.Stage, _time_range: object) -> list[UsdValidation.ValidationError]:
    kinds = {"error": UsdValidation.ValidationErrorType.Error, "warning": UsdValidation.ValidationErrorType.Warn}
    return [
        UsdValidation.ValidationError(
            found.rule, kinds[found.severity], [UsdValidation.ValidationErrorSite(stage, found.prim)], found.message
        )
        for found in check_rules(stage).findings
    ]


UsdValidation.ValidationRegistry().RegisterPluginStageValidator(HOST_VALIDATOR, _asset_rules)
