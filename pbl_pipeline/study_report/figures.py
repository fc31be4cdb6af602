"""Figures of a study, drawn with matplotlib."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from pbl_pipeline.stats import CurveTest, Estimate

from .results import CurveResult, summary

#: Colours that colour-blind people can distinguish (Okabe & Ito): the changing group, the others in order.
# Orange and blue are reserved for the sides (`render.SIDE_COLOUR`).
GROUP_COLOURS = ("#00835f", "#b4588f", "#22262b", "#7d8b00", "#7a1f4b", "#878f97")
BEFORE, AFTER = "#22262b", "#00835f"
_INK, _LINE, _PERSON, _PHASE = "#2a2e33", "#b9bfc5", "#8a939c", "#e9e6a8"
_SIZE, _NARROW = (4.9, 3.3), (3.5, 3.2)
#: Text stays text in both formats, "$" is an ordinary character, and equal figures have equal bytes.
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "pbl",
    "pdf.fonttype": 42,
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 9,
    "text.color": _INK,
    "axes.edgecolor": _LINE,
    "axes.labelcolor": _INK,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e6e9",
    "xtick.color": _INK,
    "ytick.color": _INK,
}


@dataclasses.dataclass(frozen=True)
class Figure:
    """A chart with its texts."""

    name: str  # stem of its files
    title: str
    note: str  # number of persons, and the test
    drawing: Drawing
    colours: Mapping[str, str] = dataclasses.field(default_factory=dict)  # legend: words -> colour

    def data_uri(self) -> str:
        """Return the drawing without texts as the address of an image in a page."""
        return "data:image/svg+xml;base64," + base64.b64encode(self._saved("svg")).decode()

    def svg(self, footer: Sequence[str] = ()) -> str:
        """Return an SVG file: the drawing, then legend, title, note and the lines of `footer`."""
        text = self._saved("svg", [self.title, self.note, *footer]).decode()
        label = html.escape(f"{self.title}. {self.note}")
        return text[text.index("<svg") :].replace("<svg", f'<svg role="img" aria-label="{label}"', 1)

    def pdf(self, footer: Sequence[str] = ()) -> bytes:
        """Return a PDF file with the content of `svg`."""
        return self._saved("pdf", [self.title, self.note, *footer])

    def _repr_svg_(self) -> str:
        return self.svg()

    def _saved(self, kind: str, words: Sequence[str] = ()) -> bytes:
        legend = [(f"\N{BLACK CIRCLE} {text}", colour) for text, colour in self.colours.items()]
        width = int(self.drawing.get_figwidth() * 17)
        below = [*legend, *((line, _INK) for text in words for line in textwrap.wrap(text, width))] if words else []
        box, (width_in, height_in) = self.drawing.get_tightbbox(), self.drawing.get_size_inches()
        out = io.BytesIO()
        with mpl.rc_context(_STYLE):
            texts = [  # at fractions of the figure, which a tight box moves along
                self.drawing.text(box.x0 / width_in, (box.y0 - i / 6) / height_in, text, color=colour, fontsize=7.5)
                for i, (text, colour) in enumerate(below, 1)
            ]
            undated = {"Date" if kind == "svg" else "CreationDate": None}
            self.drawing.savefig(out, format=kind, bbox_inches="tight", metadata={"Title": self.title, **undated})
        for text in texts:
            text.remove()
        return out.getvalue()


def colours_of(groups: Sequence[str]) -> dict[str, str]:
    """Return the colour of each group."""
    return {g: GROUP_COLOURS[i % len(GROUP_COLOURS)] for i, g in enumerate(groups)}


def draw_means(rows: pd.DataFrame, roles: Sequence[str], groups: Sequence[str], label: str) -> Drawing:
    """Draw mean and interval by visit, a line per group; rows of `visit_means` of one measure."""
    frame: Any = rows
    axes = _axes(_SIZE, label)
    _categories(axes, roles)
    for k, group in enumerate(groups):
        own = frame[frame["group"] == group].set_index("role")
        own = own.loc[[r for r in roles if r in own.index]]
        at = np.array([roles.index(r) for r in own.index], float) + 0.12 * (k - (len(groups) - 1) / 2)
        _intervals(axes, at, own, colours_of(groups)[group], "o-")
    return _drawing(axes)


def draw_pairs(both: pd.DataFrame, names: tuple[str, str], label: str) -> Drawing:
    """Draw a line per person from before to after, and their means with 95 % intervals."""
    values = both[["pre", "post"]].to_numpy(float)
    axes = _axes(_NARROW, label)
    _categories(axes, names)
    axes.plot([0, 1], values.T, color=_PERSON, lw=0.9, alpha=float(np.clip(3.5 / np.sqrt(len(values)), 0.15, 0.7)))
    axes.plot([0, 1], values.mean(axis=0), color=_INK, lw=2)
    for x, colour, column in ((-0.14, BEFORE, values[:, 0]), (1.14, AFTER, values[:, 1])):
        _intervals(axes, [x], pd.DataFrame([summary(column)]), colour, "o")
    return _drawing(axes)


def draw_scatter(
    parts: Mapping[str, tuple[np.ndarray, np.ndarray]],
    names: tuple[str, str],
    colours: Sequence[str],
    line: bool,
) -> Drawing:
    """Draw a dot per person, y over x, by group; with `line` the least-squares line over all."""
    x, y = (np.concatenate([p[i] for p in parts.values()]) for i in (0, 1))
    axes = _axes(_SIZE, names[1])
    axes.set_xlabel(names[0])
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    for (px, py), colour in zip(parts.values(), colours, strict=True):
        axes.scatter(px, py, 14, facecolors="white", edgecolors=colour)
    if line and len(x) > 2 and np.ptp(x) > 0:
        slope, middle = np.polyfit(x, y, 1)
        ends = np.array([x.min(), x.max()])
        axes.plot(ends, slope * ends + middle, "--", color=_INK, lw=1.2)
    return _drawing(axes)


def draw_groups(parts: Mapping[str, np.ndarray], label: str, colours: Mapping[str, str] | None = None) -> Drawing:
    """Draw values by group: a dot per person, a box of the quartiles with the median."""
    axes = _axes(_SIZE, label)
    _categories(axes, [f"{name}\nn = {len(v)}" for name, v in parts.items()])
    generator = np.random.default_rng(0)
    for i, (name, own) in enumerate(parts.items()):
        colour = colours[name] if colours else GROUP_COLOURS[0]
        if len(own) > 1:
            low, middle, high = np.percentile(own, [25, 50, 75])
            axes.bar(i, high - low, 0.56, low, color=colour, alpha=0.16)
            axes.hlines(middle, i - 0.28, i + 0.28, color=colour, lw=2)
        axes.scatter(i + generator.uniform(-0.2, 0.2, len(own)), own, 10, facecolors="white", edgecolors=colour)
    return _drawing(axes)


def draw_curves(result: CurveResult, colours: tuple[str, str], label: str) -> Drawing:
    """Draw mean curves with one standard deviation; phases of difference are shaded, with a bar below."""
    axes = _axes(_SIZE, label)
    axes.set(xlim=(0, 100), xticks=[0, 25, 50, 75, 100], xlabel="gait cycle (%)")
    if isinstance(result.test, CurveTest):
        for phase in result.test.phases:
            last = max(phase.last, phase.first + 0.5)
            axes.axvspan(phase.first, last, color=_PHASE, alpha=0.5, lw=0)
            axes.axvspan(phase.first, last, ymax=0.02, color=_INK, lw=0)
    for curves, colour, dash in zip((result.b, result.a), colours, ("-", "--"), strict=True):
        percent, mean = np.linspace(0, 100, curves.shape[1]), curves.mean(axis=0)
        sd = curves.std(axis=0, ddof=1) if len(curves) > 1 else np.zeros(curves.shape[1])
        axes.fill_between(percent, mean - sd, mean + sd, color=colour, alpha=0.16, lw=0)
        axes.plot(percent, mean, dash, color=colour, lw=1.8)
    return _drawing(axes)


def draw_forest(rows: Sequence[tuple[str, str, Estimate]]) -> Drawing:
    """Draw estimates with their intervals, one row each (name, colour, estimate), and a line at 0."""
    axes = _axes((6.5, 0.36 * len(rows) + 0.6), "")
    axes.grid(axis="both")
    axes.grid(visible=False, axis="y")
    axes.axvline(0, color=_LINE, lw=1.2)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    for i, (_, colour, found) in enumerate(rows):
        axes.hlines(i, found.low, found.high, color=colour, lw=2)
        axes.plot(found.value, i, "o", color=colour)
    return _drawing(axes)


def _axes(size: tuple[float, float], y_label: str) -> Axes:
    with mpl.rc_context(_STYLE):
        axes = Drawing(size).add_subplot()
        axes.set_ylabel(y_label)
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    return axes


def _drawing(axes: Axes) -> Drawing:
    drawing = axes.get_figure(root=True)
    assert drawing is not None
    return drawing


def _categories(axes: Axes, names: Sequence[str]) -> None:
    shown = ["\n".join(textwrap.fill(line, 14) for line in n.replace("_", " ").splitlines()) for n in names]
    axes.set_xticks(range(len(names)), shown)
    axes.set_xlim(-0.5, len(names) - 0.5)


def _intervals(axes: Axes, at: Any, rows: pd.DataFrame, colour: str, style: str) -> None:
    mean, low, high = (rows[c].to_numpy(float) for c in ("mean", "low", "high"))
    axes.errorbar(at, mean, [mean - low, high - mean], fmt=style, color=colour, lw=1.4, ms=5)
