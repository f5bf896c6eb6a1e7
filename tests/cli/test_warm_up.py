"""``beam warm-up``: what it leaves nothing to compile for."""

import pytest
from support.commands import run_beam
