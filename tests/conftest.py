"""Shared fixtures: where the development data is, and a cache that no test shares with the user."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The development recordings beside the project; tests that need them skip where they are absent."""
    if not SHARED.is_dir():
        pytest.skip("the development data (../shared/data) is absent")
    return SHARED
