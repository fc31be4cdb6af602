"""Small charts of a page as inline SVG: crisp on a phone and on paper, text in the font and language of the page.

By hand, unlike the figures of a study (matplotlib): a chart of 16 cycles takes 5 ms and 29 kB here, 52 ms and 60 kB
with matplotlib. A visit's page has 17 charts per recording, and the comparison page, which draws at each request, needs
the positions in the plot (`CYCLE_PLOT`).

Every chart is a `Markup` string in which each text has been escaped. Sizes are in the units of the view box; the page
scales a chart to its column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from markupsafe import Markup

from pbl_pipeline.render import SIDE_COLOUR
from pbl_pipeline.runs import runs

_INK, _FAINT, _GRID, _BAND = "#2a2e33", "#687078", "#e3e6e9", "#dfe3e8"
_DASH = {"right": "none", "left": "7 3"}  # sides differ in print without colour too
_CYCLE_SIZE, _CYCLE_MARGIN = (280, 200), (36, 8, 8, 22)
#: The plot of `compare_chart` in its view box: left, top, right and bottom; from left to right it is 0 to 100 %.
CYCLE_PLOT = (_CYCLE_MARGIN[0], _CYCLE_MARGIN[1], _CYCLE_SIZE[0] - _CYCLE_MARGIN[2], _CYCLE_SIZE[1] - _CYCLE_MARGIN[3])
#: Colour and dash of lines that are compared. They also differ in grey, and none is that of a side (`SIDE_COLOUR`).
SERIES = (
    ("#22262b", "none"),
    ("#00835f", "7 3"),
    ("#b4588f", "2 2.5"),
    ("#878f97", "9 3 2 3"),
    ("#7a1f4b", "5 2"),
    ("#7d8b00", "12 4"),
)


class Axes:
    """A plot area with its scales; draws the frame, ticks and labels, then takes marks in data units."""

    def __init__(
        self,
        size: tuple[float, float],
        x_range: tuple[float, float],
        y_range: tuple[float, float],
        margin: tuple[float, float, float, float] = (34, 10, 10, 26),
    ) -> None:
        self.size, self._x_range, self._y_range = size, x_range, y_range
        left, top, right, bottom = margin
        self.left, self.top, self.right, self.bottom = left, top, size[0] - right, size[1] - bottom
        self._parts: list[Markup] = []

    def x(self, v: np.ndarray | float) -> np.ndarray:
        a, b = self._x_range
        return self.left + (np.asarray(v, float) - a) / (b - a) * (self.right - self.left)

    def y(self, v: np.ndarray | float) -> np.ndarray:
        a, b = self._y_range
        return self.bottom - (np.asarray(v, float) - a) / (b - a) * (self.bottom - self.top)

    def add(self, part: Markup) -> None:
        self._parts.append(part)

    def grid(self, x_ticks: Sequence[float], y_ticks: Sequence[float], x_unit: str = "", y_unit: str = "") -> None:
        """Grid lines and tick labels; the unit stands at the last tick of x and the highest of y."""
        for v in y_ticks:
            y = float(self.y(v))
            width = 1.2 if v == 0 else 0.8
            self.line((self.left, y), (self.right, y), "#b9bfc5" if v == 0 else _GRID, width)
            unit = y_unit if v == y_ticks[-1] else ""
            self.text((self.left - 5, y + 3.6), f"{_number(v)}{unit}", "end")
        for i, v in enumerate(x_ticks):
            x = float(self.x(v))
            self.line((x, self.bottom), (x, self.bottom + 3.5), "#b9bfc5", 1)
            last = i == len(x_ticks) - 1
            label = f"{_number(v)}{x_unit}" if last else _number(v)
            self.text((x, self.bottom + 15), label, "end" if last and x > self.right - 4 and x_unit else "middle")

    def line(
        self, a: tuple[float, float], b: tuple[float, float], colour: str, width: float, dash: str = "none"
    ) -> None:
        """A line in view-box units."""
        self.add(
            Markup(
                '<line x1="{:.1f}" y1="{:.1f}" x2="{:.1f}" y2="{:.1f}" stroke="{}" stroke-width="{}"'
                ' stroke-dasharray="{}"/>'
            ).format(*a, *b, colour, width, dash)
        )

    def text(
        self, at: tuple[float, float], text: str, anchor: str = "start", colour: str = _FAINT, bold: bool = False
    ) -> None:
        """A text in view-box units."""
        self.add(
            Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}" fill="{}"{}>{}</text>').format(
                *at, anchor, colour, Markup(' font-weight="600"') if bold else "", text
            )
        )

    def band(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str = _BAND, opacity: float = 1.0) -> None:
        """A filled area between two curves."""
        there = np.stack([self.x(x), self.y(high)], axis=-1)
        back = np.stack([self.x(x), self.y(low)], axis=-1)[::-1]
        seen = Markup("") if opacity == 1.0 else Markup(' fill-opacity="{}"').format(opacity)
        points = _points(np.concatenate([there, back]))
        self.add(Markup('<polygon points="{}" fill="{}"{}/>').format(points, colour, seen))

    def curve(
        self,
        x: np.ndarray,
        y: np.ndarray,
        colour: str,
        width: float,
        opacity: float = 1.0,
        dash: str = "none",
    ) -> None:
        """A curve, or several (N, P); it is broken where `y` is NaN."""
        across, up = self.x(x), np.atleast_2d(self.y(y))
        whole = " ".join(f"{v:.1f},%.1f" for v in across.tolist())  # visits have hundreds of cycles
        lines = []
        for row in up:
            if (seen := np.isfinite(row)).all():
                lines.append(whole % tuple(row.tolist()))
            else:
                lines += [_points(np.stack([across[r], row[r]], axis=-1)) for r in runs(seen)]
        drawn = Markup("").join(map(Markup('<polyline points="{}"/>').format, lines))
        self.add(
            Markup(
                '<g fill="none" stroke="{}" stroke-width="{}" stroke-opacity="{}" stroke-dasharray="{}"'
                ' stroke-linejoin="round">{}</g>'
            ).format(colour, width, opacity, dash, drawn)
        )

    def box(self, x0: float, x1: float, y0: float, y1: float, colour: str, opacity: float = 1.0) -> None:
        self.add(
            Markup('<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" fill="{}" fill-opacity="{}"/>').format(
                min(x0, x1), min(y0, y1), abs(x1 - x0), abs(y1 - y0), colour, opacity
            )
        )

    def dot(self, x: float, y: float, colour: str, radius: float = 3.2, hollow: bool = False) -> None:
        self.add(
            Markup('<circle cx="{:.1f}" cy="{:.1f}" r="{}" fill="{}" stroke="{}" stroke-width="1.4"/>').format(
                x, y, radius, "#fff" if hollow else colour, colour
            )
        )

    def svg(self, label: str) -> Markup:
        """The chart; `label` is what a screen reader says."""
        return Markup(
            '<svg viewBox="0 0 {:g} {:g}" role="img" aria-label="{}" preserveAspectRatio="xMidYMid meet">{}</svg>'
        ).format(*self.size, label, Markup("").join(self._parts))


def cycle_chart(
    label: str,
    percent: np.ndarray,
    cycles: Mapping[str, Sequence[np.ndarray]],
    foot_off_percent: Mapping[str, float],
    norm: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
    faint: str = "",
    unit: str = "\N{DEGREE SIGN}",
    least: float = 20.0,
) -> Markup:
    """A curve, such as a joint angle, over the gait cycle: each cycle thin, the mean of a side thick, the norm a band.

    Parameters
    ----------
    percent : (P,)
        Percent of the cycle of the curves' points.
    cycles
        side -> curves (P,) in degrees.
    foot_off_percent
        side -> mean percent of the cycle at which the foot leaves the ground.
    norm
        percent (Q,), mean (Q,), sd (Q,) in degrees; None if there is none.
    faint
        The side whose curves are less certain.
    unit, least
        Behind the uppermost number of the axis; the smallest range that the axis has.
    """
    opacity = {side: 0.4 if side == faint else 1.0 for side in cycles}
    axes = _cycle_axes([c for curves in cycles.values() for c in curves], norm, unit, least)
    if norm is not None:
        axes.curve(norm[0], norm[1], "#9aa3ad", 1.2)
    for side, curves in cycles.items():
        if curves:
            axes.curve(percent, np.stack(curves), SIDE_COLOUR[side], 0.9, 0.38 * opacity[side])
    for side, curves in cycles.items():
        if not curves:
            continue
        axes.curve(percent, np.mean(curves, axis=0, dtype=float), SIDE_COLOUR[side], 2.4, opacity[side], _DASH[side])
        off = foot_off_percent.get(side, np.nan)
        if np.isfinite(off):
            x = float(axes.x(off))
            axes.line((x, axes.top), (x, axes.bottom), SIDE_COLOUR[side], 1, "2 3")
    return axes.svg(label)


def compare_chart(
    label: str,
    percent: np.ndarray,
    curves: Sequence[tuple[np.ndarray, np.ndarray] | None],
    norm: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
    reference: int = 0,
    faint: Sequence[int] = (),
) -> Markup:
    """One joint angle of one side over the gait cycle, of several visits: mean curves with bands of one sd.

    Parameters
    ----------
    percent : (P,)
        Percent of the cycle of the curves' points.
    curves
        Mean (P,) and sd (P,) in degrees, drawn as `SERIES` has it at the same place; NaN where the sd is not known,
        None for a visit without this curve. At most `len(SERIES)`.
    norm
        percent (Q,), mean (Q,), sd (Q,) in degrees; None if there is none.
    reference
        Place of the curve that is drawn thicker.
    faint
        Places of the curves that are less certain.
    """
    drawn = [(*SERIES[i], i, *c) for i, c in enumerate(curves) if c is not None]
    axes = _cycle_axes([edge for *_, mean, sd in drawn for edge in (mean, mean - sd, mean + sd)], norm)
    opacity = [0.4 if i in faint else 1.0 for i in range(len(curves))]
    for colour, _, i, mean, sd in drawn:
        if np.isfinite(sd).all():
            axes.band(percent, mean - sd, mean + sd, colour, 0.14 * opacity[i])
    for colour, dash, i, mean, _ in drawn:
        axes.curve(percent, mean, colour, 2.6 if i == reference else 1.8, opacity[i], dash)
    return axes.svg(label)


def _cycle_axes(
    values: Sequence[np.ndarray],
    norm: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
    unit: str = "\N{DEGREE SIGN}",
    least: float = 20.0,
) -> Axes:
    """Return the plot area of a curve over the gait cycle (%) with room for `values` and the norm's band."""
    edges = [] if norm is None else [norm[1] - norm[2], norm[1] + norm[2]]
    ticks = nice_ticks(*_extent([*values, *edges], least=least))
    axes = Axes(_CYCLE_SIZE, (0, 100), (ticks[0], ticks[-1]), margin=_CYCLE_MARGIN)
    if norm is not None:
        axes.band(norm[0], edges[0], edges[1])
    axes.grid([0, 25, 50, 75, 100], ticks, "\N{NO-BREAK SPACE}%", unit)
    return axes


def series_key(place: int) -> Markup:
    """A sample of a line of `compare_chart`."""
    colour, dash = SERIES[place]
    return Markup(
        '<svg viewBox="0 0 30 12" class="series" aria-hidden="true"><line x1="0" y1="6" x2="30" y2="6" stroke="{}"'
        ' stroke-width="3" stroke-dasharray="{}"/></svg>'
    ).format(colour, dash)


def time_chart(
    label: str,
    time_s: np.ndarray,
    curves: Mapping[str, np.ndarray],
    spans: Mapping[str, Sequence[tuple[float, float]]],
) -> Markup:
    """A joint angle of both sides over the recording; the stance of each side as a bar at the foot of the plot.

    curves: side -> (T,) degrees, NaN where unknown. spans: side -> (start, stop) in s.
    """
    ticks = nice_ticks(*_extent(list(curves.values()), least=20.0))
    stop = float(time_s[-1]) if len(time_s) else 1.0
    axes = Axes((280, 150), (0, max(stop, 1e-3)), (ticks[0], ticks[-1]), margin=_CYCLE_MARGIN)
    axes.grid(_inside(nice_ticks(0, stop), stop), ticks, "\N{NO-BREAK SPACE}s", "\N{DEGREE SIGN}")
    for row, (side, bars) in enumerate(spans.items()):
        y = axes.bottom - 3 - 5 * row
        for a, b in bars:
            axes.box(float(axes.x(a)), float(axes.x(b)), y, y - 3, SIDE_COLOUR[side], 0.7)
    for side, c in curves.items():
        axes.curve(time_s, c, SIDE_COLOUR.get(side, SIDE_COLOUR["middle"]), 1.6, 1.0, _DASH.get(side, "none"))
    return axes.svg(label)


def contact_chart(
    label: str,
    stop_s: float,
    known: Sequence[tuple[float, float]],
    spans: Mapping[str, Sequence[tuple[float, float]]],
    events: Sequence[tuple[float, str, str]],
) -> Markup:
    """Foot contacts over the recording: stance bars, a triangle down for initial contact and up for toe-off.

    known: stretches (start, stop) in s in which the person is fitted; events: (time_s, side, event).
    """
    axes = Axes((1040, 112), (0, max(stop_s, 1e-3)), (0, 1), margin=(52, 6, 14, 26))
    rows = {"left": axes.top + 20, "right": axes.top + 58}
    for a, b in known:
        axes.box(float(axes.x(a)), float(axes.x(b)), axes.top, axes.bottom, "#f3f5f7")
    axes.grid(_inside(nice_ticks(0, stop_s, 12), stop_s), [], "\N{NO-BREAK SPACE}s")
    axes.line((axes.left, axes.bottom), (axes.right, axes.bottom), "#b9bfc5", 1)
    for side, y in rows.items():
        colour = SIDE_COLOUR[side]
        axes.text((axes.left - 8, y + 4), side.capitalize(), "end", colour, bold=True)
        axes.line((axes.left, y), (axes.right, y), _GRID, 1)
        for a, b in spans.get(side, ()):
            axes.box(float(axes.x(a)), float(axes.x(b)), y - 7, y + 7, colour, 0.45)
    for t, side, kind in events:
        x, y, colour = float(axes.x(t)), rows[side], SIDE_COLOUR[side]
        sign = 1 if kind == "foot_down" else -1
        corners = np.array([[x - 4.5, y - 13 * sign], [x + 4.5, y - 13 * sign], [x, y - 6 * sign]])
        axes.line((x, y - 7), (x, y + 7), colour, 1.6)
        axes.add(Markup('<polygon points="{}" fill="{}"/>').format(_points(corners), colour))
    return axes.svg(label)


def index_chart(label: str, values: Mapping[str, Sequence[float]]) -> Markup:
    """Gait deviation index of single cycles as dots per side; 100 is the norm, each 10 points one sd."""
    every = [v for side in values.values() for v in side if np.isfinite(v)]
    low, high = min([70.0, *(v - 4 for v in every)]), max([120.0, *(v + 4 for v in every)])
    ticks = [t for t in nice_ticks(low, high) if t == round(t)]
    axes = Axes((400, 104), (ticks[0], ticks[-1]), (0, 1), margin=(52, 6, 16, 26))
    axes.box(float(axes.x(90)), float(axes.x(min(110, ticks[-1]))), axes.top, axes.bottom, _BAND)
    for t in ticks:
        axes.line((float(axes.x(t)), axes.top), (float(axes.x(t)), axes.bottom), _GRID, 1)
    axes.line((float(axes.x(100)), axes.top), (float(axes.x(100)), axes.bottom), "#9aa3ad", 1.2)
    axes.grid(ticks, [])
    for side, y in (("left", axes.top + 20), ("right", axes.top + 54)):
        colour = SIDE_COLOUR[side]
        axes.text((axes.left - 8, y + 4), side.capitalize(), "end", colour, bold=True)
        own = [v for v in values.get(side, ()) if np.isfinite(v)]
        for v in own:
            axes.dot(float(axes.x(v)), y, colour, hollow=True)
        if own:
            x = float(axes.x(float(np.mean(own))))
            axes.line((x, y - 10), (x, y + 10), colour, 2.4)
    return axes.svg(label)


def trend_chart(
    label: str,
    days: Sequence[float],
    names: Sequence[str],
    values: Sequence[tuple[float, tuple[float, float] | None, Mapping[str, float]]],
    norm: tuple[float, float] | None = None,
) -> Markup:
    """A value at several visits: a dot at each with its interval, small hollow ones for the sides.

    days, names: of each visit, in order; a name that has no room is left out. values: the value, its interval (None:
    not known), side -> value. norm: lowest and highest of a grey band.
    """
    every = [np.array([v, *(bounds or ()), *sides.values()], float) for v, bounds, sides in values]
    ticks = nice_ticks(*_extent([*every, np.array(norm or ())], least=1e-3))
    span = max(days[-1] - days[0], 1.0)
    axes = Axes(
        (460, 240), (days[0] - 0.08 * span, days[-1] + 0.08 * span), (ticks[0], ticks[-1]), margin=(44, 10, 10, 26)
    )
    if norm is not None:
        axes.box(axes.left, axes.right, float(axes.y(norm[0])), float(axes.y(norm[1])), _BAND)
    axes.grid([], ticks)
    axes.curve(np.array(days, float), np.array([v for v, _, _ in values]), _FAINT, 1.2)
    written = -np.inf
    for day, name, (value, bounds, sides) in zip(days, names, values, strict=True):
        x = float(axes.x(day))
        if bounds is not None:
            axes.line((x, float(axes.y(bounds[0]))), (x, float(axes.y(bounds[1]))), _INK, 1.6)
        for side, of_side in sides.items():
            axes.dot(x + (-6 if side == "left" else 6), float(axes.y(of_side)), SIDE_COLOUR[side], 2.6, hollow=True)
        axes.dot(x, float(axes.y(value)), _INK, 4)
        if x - written > 64:
            axes.text((x, axes.bottom + 16), name, "middle")
            written = x
    return axes.svg(label)


def nice_ticks(low: float, high: float, n: int = 5) -> list[float]:
    """Round numbers (steps of 1, 2 or 5 times a power of ten) that enclose low..high, about n of them."""
    span = max(high - low, 1e-9)
    power = 10.0 ** np.floor(np.log10(span / n))
    step = next(float(m * power) for m in (1, 2, 5, 10) if span / (m * power) <= n + 1e-9)
    first, last = int(np.floor(low / step + 1e-9)), int(np.ceil(high / step - 1e-9))
    return [round(i * step, 10) for i in range(first, max(last, first + 1) + 1)]


def _inside(ticks: list[float], stop: float) -> list[float]:
    return [t for t in ticks if t <= stop * 1.0001]


def _extent(values: Sequence[np.ndarray], least: float) -> tuple[float, float]:
    """Lowest and highest of all values, at least `least` apart; 0..least where nothing is known."""
    seen = np.concatenate([v[np.isfinite(v)] for v in (np.asarray(v, float) for v in values)] or [np.zeros(0)])
    if not len(seen):
        return 0.0, least
    low, high = float(seen.min()), float(seen.max())
    pad = max(0.0, least - (high - low)) / 2
    return low - pad, high + pad


def _number(v: float) -> str:
    return f"{v:g}".replace("-", "\N{MINUS SIGN}")


def _points(p: np.ndarray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in p.tolist())
