"""Figures of a study."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from pbl_pipeline.charts import Axes, nice_ticks
from pbl_pipeline.stats import CurveTest, Estimate

from ._results import CurveResult, summary

#: Colours that differ also for the colour-blind (Okabe & Ito): the changing group, the others in order.
GROUP_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
BEFORE, AFTER = "#0072b2", "#d55e00"
_INK, _LINE, _PERSON, _PHASE = "#2a2e33", "#b9bfc5", "#8a939c", "#f4d9a8"
_WIDE, _SIZE, _NARROW = 470, (350, 240), (250, 230)
_MARGIN = (48, 12, 12, 38)


@dataclasses.dataclass(frozen=True)
class Figure:
    """A chart with its words.

    Attributes
    ----------
    name
        Stem of its files.
    title, note
        What it shows; how many persons and which test.
    axes
        The drawing.
    colours
        Legend: words -> colour.
    """

    name: str
    title: str
    note: str
    axes: Axes
    colours: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def svg(self, footer: Sequence[str] = ()) -> Markup:
        """The figure as SVG; with a footer, and then its legend, it is a file of its own."""
        return self.axes.svg(f"{self.title}. {self.note}", footer, self.colours if footer else None)

    def _repr_svg_(self) -> str:
        """In a notebook: with title, note and legend below."""
        return self.standalone()

    def standalone(self, footer: Sequence[str] = ()) -> str:
        """As a file of its own, with its words and the lines of `footer` below."""
        room = int(self.axes.size[0] / 4.4)
        lines = [line for text in (self.title, self.note, *footer) for line in textwrap.wrap(text, room)]
        start = '<svg xmlns="http://www.w3.org/2000/svg" style="font:11px sans-serif" '
        return start + str(self.svg(lines)).removeprefix("<svg ") + "\n"


def colours_of(groups: Sequence[str]) -> dict[str, str]:
    """Group -> colour."""
    return {g: GROUP_COLOURS[i % len(GROUP_COLOURS)] for i, g in enumerate(groups)}


def means_axes(rows: pd.DataFrame, roles: Sequence[str], groups: Sequence[str], unit: str) -> Axes:
    """Mean and interval by visit, a line per group; rows of `visit_means` of one measure."""
    frame: Any = rows
    ends = frame[["low", "high", "mean"]].to_numpy(float)
    axes = _axes(_SIZE, (-0.5, len(roles) - 0.5), ends, unit)
    _categories(axes, roles)
    for k, group in enumerate(groups):
        own = frame[frame["group"] == group].set_index("role")
        at = np.array([i for i, r in enumerate(roles) if r in own.index], float) + 0.12 * (k - (len(groups) - 1) / 2)
        own = own.loc[[r for r in roles if r in own.index]]
        colour = colours_of(groups)[group]
        axes.curve(at, own["mean"].to_numpy(float), colour, 1.6)
        for x, low, high, mean in zip(at, own["low"], own["high"], own["mean"], strict=True):
            _bar(axes, x, low, high, colour)
            axes.dot(float(axes.x(x)), float(axes.y(mean)), colour)
    return axes


def paired_axes(both: pd.DataFrame, names: tuple[str, str], unit: str) -> Axes:
    """A line per person from before to after, their means with 95 % intervals beside."""
    values = both[["pre", "post"]].to_numpy(float)
    axes = _axes(_NARROW, (-0.45, 1.45), values, unit)
    _categories(axes, names)
    faint = float(np.clip(3.5 / np.sqrt(len(values)), 0.15, 0.7))
    for row in values:
        axes.curve(np.array([0.0, 1.0]), row, _PERSON, 1.1, faint)
    mean = values.mean(axis=0)
    axes.curve(np.array([0.0, 1.0]), mean, _INK, 2.6)
    for x, colour, column in ((-0.14, BEFORE, values[:, 0]), (1.14, AFTER, values[:, 1])):
        of_all = summary(column)
        _bar(axes, x, of_all["low"], of_all["high"], colour)
        axes.dot(float(axes.x(x)), float(axes.y(of_all["mean"])), colour, 4)
    return axes


def scatter_axes(
    parts: Mapping[str, tuple[np.ndarray, np.ndarray]],
    names: tuple[str, str],
    colours: Sequence[str],
    line: bool,
) -> Axes:
    """A dot per person, y over x, by group; with the line of least squares over all where `line`."""
    x, y = (np.concatenate([p[i] for p in parts.values()]) for i in (0, 1))
    x_ticks = _ticks(x)
    axes = _axes(_SIZE, (x_ticks[0], x_ticks[-1]), y, "", x_ticks)
    axes.text(((axes.left + axes.right) / 2, axes.size[1] - 8), names[0], "middle")
    axes.text((axes.left + 4, axes.top + 2), names[1])
    for (px, py), colour in zip(parts.values(), colours, strict=True):
        for a, b in zip(px, py, strict=True):
            axes.dot(float(axes.x(a)), float(axes.y(b)), colour, 2.8, hollow=True)
    if line and len(x) > 2 and np.ptp(x) > 0:
        slope, middle = np.polyfit(x, y, 1)
        ends = np.array([x.min(), x.max()])
        axes.curve(ends, slope * ends + middle, _INK, 1.4, dash="5 3")
    return axes


def groups_axes(parts: Mapping[str, np.ndarray], unit: str, colours: Mapping[str, str] | None = None) -> Axes:
    """Values by group: a dot per person, a box of the quartiles with the median."""
    values = np.concatenate(list(parts.values()))
    axes = _axes(_SIZE, (-0.5, len(parts) - 0.5), values, unit)
    _categories(axes, list(parts), [f"n = {len(v)}" for v in parts.values()])
    generator = np.random.default_rng(0)
    for i, (name, own) in enumerate(parts.items()):
        colour = colours[name] if colours else GROUP_COLOURS[0]
        if len(own) > 1:
            low, middle, high = np.percentile(own, [25, 50, 75])
            left, right = float(axes.x(i - 0.28)), float(axes.x(i + 0.28))
            axes.box(left, right, float(axes.y(low)), float(axes.y(high)), colour, 0.16)
            axes.line((left, float(axes.y(middle))), (right, float(axes.y(middle))), colour, 2.4)
        for v, shift in zip(own, generator.uniform(-0.2, 0.2, len(own)), strict=True):
            axes.dot(float(axes.x(i + shift)), float(axes.y(v)), colour, 2.4, hollow=True)
    return axes


def curves_axes(result: CurveResult, colours: tuple[str, str], unit: str) -> Axes:
    """Mean curves with one standard deviation each way; where they differ, a shaded phase and a bar at the foot."""
    both = [result.b, result.a]
    ends = np.concatenate([np.concatenate([c.mean(axis=0) + k * _sd(c) for k in (-1, 1)]) for c in both])
    axes = _axes(_SIZE, (0, 100), ends, unit, [0, 25, 50, 75, 100], "\N{NO-BREAK SPACE}%")
    percent = np.linspace(0, 100, both[0].shape[1])
    if isinstance(result.test, CurveTest):
        for phase in result.test.phases:
            x0, x1 = float(axes.x(phase.first)), float(axes.x(phase.last))
            axes.box(x0, max(x1, x0 + 1.5), axes.top, axes.bottom, _PHASE, 0.5)
            axes.box(x0, max(x1, x0 + 1.5), axes.bottom - 5, axes.bottom, _INK)
    for curves, colour in zip(both, colours, strict=True):
        mean, sd = curves.mean(axis=0), _sd(curves)
        axes.add(Markup('<g opacity="0.16">'))
        axes.band(percent, mean - sd, mean + sd, colour)
        axes.add(Markup("</g>"))
    for curves, colour, dash in zip(both, colours, ("none", "7 3"), strict=True):
        axes.curve(percent, curves.mean(axis=0), colour, 2.2, dash=dash)
    axes.text(((axes.left + axes.right) / 2, axes.size[1] - 8), "gait cycle", "middle")
    return axes


def forest_axes(rows: Sequence[tuple[str, str, Estimate]]) -> Axes:
    """Estimates with their intervals, one row each: name, colour, estimate; a line at 0."""
    ends = np.array([v for _, _, e in rows for v in (e.low, e.high, e.value, 0.0)])
    ticks = nice_ticks(float(ends.min()), float(ends.max()))
    height = 26 * len(rows) + 44
    axes = Axes(
        (_WIDE, height), (ticks[0], ticks[-1]), (0, 1), margin=(6.3 * max(len(n) for n, _, _ in rows) + 12, 8, 14, 28)
    )
    for t in ticks:
        x = float(axes.x(t))
        axes.line((x, axes.top), (x, axes.bottom), _LINE if t == 0 else "#e3e6e9", 1.2 if t == 0 else 0.8)
    axes.grid(ticks, [])
    for i, (name, colour, found) in enumerate(rows):
        y = axes.top + 18 + 26 * i
        axes.text((axes.left - 10, y + 4), name, "end", _INK)
        axes.line((float(axes.x(found.low)), y), (float(axes.x(found.high)), y), colour, 2)
        axes.dot(float(axes.x(found.value)), y, colour, 4)
    return axes


def _axes(
    size: tuple[float, float],
    x_range: tuple[float, float],
    values: np.ndarray,
    unit: str,
    x_ticks: Sequence[float] = (),
    x_unit: str = "",
) -> Axes:
    known = values[np.isfinite(values)]
    ticks = _ticks(known)
    axes = Axes(size, x_range, (ticks[0], ticks[-1]), margin=_MARGIN)
    axes.grid(x_ticks, ticks, x_unit, f"\N{NO-BREAK SPACE}{unit}" if unit and len(unit) < 4 else "")
    axes.line((axes.left, axes.bottom), (axes.right, axes.bottom), _LINE, 1)
    return axes


def _ticks(values: np.ndarray) -> list[float]:
    """Round numbers around values, also around one alone."""
    low, high = float(values.min()), float(values.max())
    room = 0.0 if high > low else max(0.1 * abs(high), 1e-3)
    return nice_ticks(low - room, high + room)


def _categories(axes: Axes, names: Sequence[str], below: Sequence[str] = ()) -> None:
    """Names along x, at 0, 1, ..."""
    room = (axes.right - axes.left) / max(len(names), 1) / 6.2
    for i, name in enumerate(names):
        text = name.replace("_", " ")
        shown = text if len(text) <= room else f"{text[: max(int(room) - 1, 1)]}\N{HORIZONTAL ELLIPSIS}"
        axes.text((float(axes.x(i)), axes.bottom + 15), shown, "middle", _INK)
        if below:
            axes.text((float(axes.x(i)), axes.bottom + 29), below[i], "middle")


def _bar(axes: Axes, x: float, low: float, high: float, colour: str) -> None:
    if np.isfinite([low, high]).all():
        at = float(axes.x(x))
        axes.line((at, float(axes.y(low))), (at, float(axes.y(high))), colour, 1.8)


def _sd(curves: np.ndarray) -> np.ndarray:
    return curves.std(axis=0, ddof=1) if len(curves) > 1 else np.zeros(curves.shape[1])
