"""The strip below the picture: knee flexion and foot contacts over the whole recording, with a moving cursor."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Protocol

import cv2
import numpy as np

from pbl_pipeline.body import joint_angles
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.render.drawing import SIDE_COLOUR, bgr
from pbl_pipeline.runs import runs

_INK, _FAINT, _GRID, _PAPER = (51, 46, 42), (120, 112, 104), (232, 228, 224), (255, 255, 255)
_FONT_NAME = "sans"  # OpenCV carries this font itself


class Event(Protocol):
    """What is drawn of a gait event: `side` "left" or "right", `event` "foot_down" or "foot_up"."""

    @property
    def time_s(self) -> float: ...
    @property
    def side(self) -> str: ...
    @property
    def event(self) -> str: ...


def stance_spans(events: Iterable[Event], side: str) -> list[tuple[float, float]]:
    """Times (foot down, foot up) in which the foot of `side` is known to be on the ground.

    Only a foot-down that is followed by a foot-up makes a span: before the first and after the last event, and between
    two events of one kind, nothing is claimed.
    """
    own = sorted((float(e.time_s), str(e.event)) for e in events if e.side == side)
    pairs = itertools.pairwise(own)
    return [(t0, t1) for (t0, kind0), (t1, kind1) in pairs if kind0 == "foot_down" and kind1 == "foot_up"]


class Strip:
    """A picture (height, width, 3) BGR that is drawn once; `frame(t)` adds the cursor of time t."""

    def __init__(self, fit: TrialFit, events: Sequence[Event], width: int, height: int) -> None:
        self._font = cv2.FontFace(_FONT_NAME)
        self._height = height
        self._text_px = max(9, round(height * 0.105))
        self._left, self._right = round(width * 0.012) + 3 * self._text_px, width - round(width * 0.012) - 1
        time = np.asarray(fit.time_s, float)
        self._t0, self._t1 = float(time[0]), float(max(time[-1], time[0] + 1e-3))
        self._plot = (round(height * 0.20), round(height * 0.61))
        self._rows = {"left": round(height * 0.73), "right": round(height * 0.885)}
        self._picture = np.full((height, width, 3), _PAPER, np.uint8)
        self._draw_knees(fit, time)
        self._draw_contacts(events)

    def frame(self, time_s: float) -> np.ndarray:
        """The strip with the cursor at `time_s`."""
        picture = self._picture.copy()
        x = round(float(self._x(time_s)))
        cv2.line(picture, (x, self._plot[0] - 2), (x, self._height - 2), _INK, 1, cv2.LINE_AA)
        self._text(picture, f"{time_s:.2f} s", (self._right, round(self._height * 0.13)), _INK, right=True)
        return picture

    def _draw_knees(self, fit: TrialFit, time: np.ndarray) -> None:
        top, bottom = self._plot
        angles = joint_angles(fit.joint_names, fit.qpos)
        curves = {s: angles[f"knee_flexion_{s[0]}"] for s in ("left", "right") if f"knee_flexion_{s[0]}" in angles}
        seen = np.concatenate([c[np.isfinite(c)] for c in curves.values()] or [np.zeros(0)])
        high = max(70.0, float(seen.max(initial=0.0)))
        low = min(0.0, float(seen.min(initial=0.0)))

        def y(deg: np.ndarray | float) -> np.ndarray:
            return bottom - (np.asarray(deg, float) - low) / (high - low) * (bottom - top)

        for tick in (0, 60):
            row = round(float(y(tick)))
            cv2.line(self._picture, (self._left, row), (self._right, row), _GRID, 1)
            self._text(
                self._picture, f"{tick}\N{DEGREE SIGN}", (self._left - 5, row + self._text_px // 3), _FAINT, True
            )
        title_row = round(self._height * 0.13)
        end = self._text(self._picture, "Knee flexion", (self._left, title_row), _INK)
        for side in ("left", "right"):
            end = self._text(self._picture, side, (end + self._text_px, title_row), bgr(SIDE_COLOUR[side]), weight=600)
        for side, curve in curves.items():
            points = np.stack([self._x(time), y(curve)], axis=-1)
            for run in runs(np.isfinite(points).all(axis=1)):
                corners = np.rint(points[run] * 16).astype(np.int32)
                cv2.polylines(self._picture, [corners], False, bgr(SIDE_COLOUR[side]), 2, cv2.LINE_AA, 4)

    def _draw_contacts(self, events: Sequence[Event]) -> None:
        half = max(2, round(self._height * 0.04))
        for side, row in self._rows.items():
            colour = bgr(SIDE_COLOUR[side])
            self._text(self._picture, side[0].upper(), (self._left - 6, row + self._text_px // 3), colour, True, 600)
            cv2.line(self._picture, (self._left, row), (self._right, row), _GRID, 1)
            pale = tuple(int(c + (255 - c) * 0.45) for c in colour)
            for t0, t1 in stance_spans(events, side):
                a, b = (round(float(v)) for v in self._x(np.array([t0, t1])))
                cv2.rectangle(self._picture, (a, row - half), (b, row + half), pale, -1)
            for e in events:
                if e.side == side:
                    x, sign = round(float(self._x(e.time_s))), 1 if e.event == "foot_down" else -1
                    cv2.line(self._picture, (x, row - half), (x, row + half), colour, 2)
                    # A small triangle that points to the ground line: from above for down, from below for up.
                    base, tip = row - sign * (2 * half), row - sign * half
                    corners = np.array([[x - half, base], [x + half, base], [x, tip]], np.int32)
                    cv2.fillConvexPoly(self._picture, corners, colour, cv2.LINE_AA)

    def _x(self, time_s: np.ndarray | float) -> np.ndarray:
        part = (np.asarray(time_s, float) - self._t0) / (self._t1 - self._t0)
        return self._left + part * (self._right - self._left)

    def _text(
        self,
        picture: np.ndarray,
        text: str,
        at: tuple[int, int],
        colour: tuple[int, int, int],
        right: bool = False,
        weight: int = 400,
    ) -> int:
        """Write `text` with its base line at `at` (left end, or right end if `right`); returns the x it ends at."""
        flags = cv2.PUT_TEXT_ALIGN_RIGHT if right else cv2.PUT_TEXT_ALIGN_LEFT
        end, _ = cv2.putText(picture, text, at, colour, self._font, self._text_px, weight, flags)
        return int(end[0])
