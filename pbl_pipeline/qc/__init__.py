"""Quality checks: every verdict carries its value, its threshold and advice."""

from ._check import EMPTY, FAIL, NEEDS_CHOICE, OUTCOMES, PASS, WARN, Check, failed, in_session, warn_if, worst
from ._order import ORDER, in_order
