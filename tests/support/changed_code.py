"""Another version of the code, as far as results can tell."""

from contextlib import contextmanager

import pytest

from beam_warp.digests import code_digest


@contextmanager
def changed_code():
    """Let the digest of the code be another one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("beam_warp.digests.source_digest", lambda folders: "another algorithm")
        code_digest.cache_clear()
        yield
    code_digest.cache_clear()
