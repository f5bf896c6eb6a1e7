"""Results that do not depend on the number of threads."""

import numpy as np


def require_same_on_any_threads(monkeypatch, run, numbers=("1", "3")):
    """Require that a function returns arrays of the same bits on every number of threads."""
    found = []
    for number in numbers:
        monkeypatch.setenv("BEAM_WARP_THREADS", number)
        found.append(run())
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            assert np.asarray(one).tobytes() == np.asarray(same).tobytes()
