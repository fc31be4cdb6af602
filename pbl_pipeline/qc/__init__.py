"""Quality checks: every verdict carries its value, its threshold and advice."""

from ._check import EMPTY, FAIL, FIT_FAILED, NEEDS_CHOICE, OUTCOMES, PASS, WARN, Check, in_session, withheld, worst

__all__ = [
    "EMPTY",
    "FAIL",
    "FIT_FAILED",
    "NEEDS_CHOICE",
    "OUTCOMES",
    "PASS",
    "WARN",
    "Check",
    "in_session",
    "withheld",
    "worst",
]
