from pxr import UsdValidation as V


def f(stage, timeRange):
    return [
        V.ValidationError("BEAM-GEO-001", V.ValidationErrorType.Error, [V.ValidationErrorSite(stage, "/")], "hello")
    ]


V.ValidationRegistry().RegisterPluginStageValidator("beam_warp.schema.host_validator:AssetRules", f)
