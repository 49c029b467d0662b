"""``smal`` in the process of the test, as the tests of commands have it."""

from tests.services.cli.conftest import smal

__all__ = ["smal"]
