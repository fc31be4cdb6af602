"""Quality checks: every verdict carries its value, its threshold and advice."""

from ._check import (
    CADENCE,
    EMPTY,
    FAIL,
    NEEDS_CHOICE,
    OUTCOME_TYPE,
    OUTCOMES,
    PASS,
    WARN,
    Check,
    failed,
    in_order,
    in_session,
    warn_if,
    worst,
)
