"""The written contract of an asset on disk, and what reads, writes and validates it.

`register` tells OpenUSD about the two applied API schemas of this folder. The reader, the writer and the validator
call it; call it yourself before you open a stage with OpenUSD if you want ``prim.HasAPI`` and fallback values.
Importing this package loads no USD.
"""

from __future__ import annotations

import warnings
from pathlib import Path

SCHEMA_VERSION = "1.3"
"""Version of the schema that this package writes, major.minor; the policy is in CHANGES.md."""

MATERIAL_API = "BeamRelightableGaussianAPI"
"""Identifier of the applied schema on the prim that holds the Gaussians."""

SEQUENCE_API = "BeamSequenceAPI"
"""Identifier of the applied schema on the asset's root prim."""

PLUGIN_FOLDER = Path(__file__).parent
"""The folder to put on ``PXR_PLUGINPATH_NAME`` so that another USD host knows the schema."""


def register() -> bool:
    """Make OpenUSD know the schema; cheap to call again.

    Assets read and write correctly without it, since every attribute is authored with its type; what needs it is
    ``HasAPI``, ``ApplyAPI``, fallback values and OpenUSD's own type checks.

    Returns:
        True if OpenUSD knows the schema now. False, with a ``UserWarning`` that says what to do, if OpenUSD had
        loaded its schemas before this call: it never looks for new ones.
    """
    from pxr import Plug, Usd

    Plug.Registry().RegisterPlugins(str(PLUGIN_FOLDER))
    if Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(MATERIAL_API) is not None:
        return True
    warnings.warn(
        "The beam schema must be registered before OpenUSD loads its schemas, got a process that has loaded them "
        f"already. Call beam_warp.schema.register() before opening the first stage, or set PXR_PLUGINPATH_NAME="
        f"{PLUGIN_FOLDER} before the program starts; until then HasAPI and fallback values are missing, data is not.",
        UserWarning,
        stacklevel=2,
    )
    return False
