"""Keypoints of the tracked person, behind one protocol for every detector."""

from ._types import Keypoints

__all__ = ["Keypoints"]
