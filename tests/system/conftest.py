"""The ``smal`` command as a user runs it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable

import pytest

from tests.command import run_smal

Smal = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="session")
def smal() -> Smal:
    """Give ``run_smal``."""
    return run_smal
