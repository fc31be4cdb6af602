"""Foot down and foot up of both sides."""

from ._detect import detect_events, resolve_params
from ._types import (
    DEFAULT_EVENT_PARAMSET,
    EVENT_PARAMSETS,
    EVENTS,
    FOOT_DOWN,
    FOOT_UP,
    LEFT,
    RIGHT,
    SIDES,
    EventParams,
    GaitEvent,
    GaitEvents,
    load_events,
)

__all__ = [
    "DEFAULT_EVENT_PARAMSET",
    "EVENTS",
    "EVENT_PARAMSETS",
    "FOOT_DOWN",
    "FOOT_UP",
    "LEFT",
    "RIGHT",
    "SIDES",
    "EventParams",
    "GaitEvent",
    "GaitEvents",
    "detect_events",
    "load_events",
    "resolve_params",
]
