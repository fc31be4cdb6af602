"""Tests of the product."""

from pathlib import Path

#: The development data beside the project.
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
