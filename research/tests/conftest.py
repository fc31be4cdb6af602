"""The fixtures of the tests of `research`: those of `tests`."""

from tests.conftest import nothing_of_the_developer, shared_data

__all__ = ["nothing_of_the_developer", "shared_data"]
