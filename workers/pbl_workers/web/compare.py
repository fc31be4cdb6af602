"""Compare: results side by side, curves over each other, videos in step by gait phase."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlencode

import numpy as np
from markupsafe import Markup
from starlette.requests import Request
from starlette.responses import Response

from pbl_pipeline import charts, texts
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.names import whole_number
from pbl_pipeline.words import ANGLES, FOOT_ANGLES, PELVIS_ANGLES, number
from pbl_schemas.reading import comparison

from . import pages, site
from .address import interval, page
from .pages import as_json, plain, reader_language, visit_name


@dataclasses.dataclass(frozen=True)
class Chart:
    """Curves of one angle. sides: "left" and "right" with their pictures; far: by side the places of the results in
    which that leg was behind the other."""

    title: str
    positive: str
    sides: dict[str, Markup]
    far: dict[str, list[int]]


async def show(request: Request) -> Response:
    from pbl_pipeline.gait import IMPORTANT_CHANGE

    chosen = [_read(text) for text in request.query_params.getlist("v")[:100]]
    wanted = request.query_params.get("ref", "")
    found = await site.ask(request, comparison.compare, chosen, _read(wanted) if wanted else None)
    language = "en" if as_json(request) else reader_language(request)
    names = [_name(c, language) for c in found.compared]
    cycles = [c.cycles for c in found.compared]
    shown: dict[int, PblError | None] = {}
    for video_id in {c.video_id for of_result in cycles for c in of_result}:
        try:
            await site.ask(request, site.of(request).source.video, video_id)
            shown[video_id] = None
        except PblError as error:
            shown[video_id] = error
    if as_json(request):  # loads arrays, which not every thread may
        return pages.show(request, "", **await site.ask(request, plain, {"found": found, "names": names}))
    return pages.show(
        request,
        "compare.html",
        found=found,
        names=names,
        keys=[charts.series_key(i) for i in range(len(names))],
        measures=[n for n in _names(found) if any(_known(c, n) for c in found.compared)],
        without=without(found),
        of_cycles=[n for n in _names(found) if any(_interval(c, n) is not None for c in found.compared)],
        charts=charts_of(found, names, language),
        plot=charts.CYCLE_PLOT,
        first_cycle=[_first_cycle(c, cycles) for c in cycles],
        videos=shown,
        as_reference=[_address(found, i) for i in range(len(names))],
        interval=interval,
        bounds=_bounds,
        percent=lambda p: number(100.0 * min(p, 0.99), 0),
        least_important=IMPORTANT_CHANGE,
        now=datetime.datetime.now(datetime.UTC),
        version=code_version(),
    )


ROUTES = page("/compare", show, "look")


def charts_of(found: comparison.Comparison, names: Sequence[str], language: str = "en") -> list[Chart]:
    """Return the charts of all angles with curves, in the order of the report."""
    out = []
    for angle, (title, positive) in (ANGLES | FOOT_ANGLES | PELVIS_ANGLES).items():
        sides, far = {}, {}
        for side in ("left", "right"):
            frames: list[Any] = [
                c.curves[(c.curves["angle"] == angle) & (c.curves["side"] == side)] for c in found.compared
            ]
            first = next((f for f in frames if len(f)), None)
            if first is None:
                continue
            of_reference = frames[found.reference] if len(frames[found.reference]) else first
            curves = [(f["mean_deg"].to_numpy(float), f["sd_deg"].to_numpy(float)) if len(f) else None for f in frames]
            far[side] = [i for i, c in enumerate(found.compared) if c.far_leg == side and len(frames[i])]
            means = []
            for i, (name, c) in enumerate(zip(names, curves, strict=True)):
                if c is not None:
                    uncertain = f" ({texts.text(language, 'compare.uncertain')})" if i in far[side] else ""
                    low, high = number(float(c[0].min()), 0), number(float(c[0].max()), 0)
                    bounds = texts.text(language, "entry.range", low=low, high=high)
                    means.append(f"{name} {bounds}\N{DEGREE SIGN}{uncertain}")
            of_chart = {"name": texts.library_words(language, title), "side": texts.text(language, f"visit.{side}")}
            label = texts.text(language, "compare.chart", **of_chart, means="; ".join(means))
            sides[side] = charts.compare_chart(
                label, first["percent"].to_numpy(float), curves, _norm(of_reference), found.reference, far[side]
            )
        if sides:
            out.append(Chart(title, positive, sides, far))
    return out


def _norm(frame: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    columns = tuple(frame[c].to_numpy(float) for c in ("percent", "normal_mean_deg", "normal_sd_deg"))
    return (columns[0], columns[1], columns[2]) if np.isfinite(columns[1]).all() else None


def _interval(one: comparison.Side, name: str) -> tuple[float, float] | None:
    """The interval of a measure if it is that of the spread of its cycles alone; None if it has none."""
    value, _ = one.about.all_measures.get(name, (None, ""))
    return None if value is None or value.error_sd is not None else value.interval


def _known(one: comparison.Side, name: str) -> bool:
    return one.about.all_measures.get(name, (None, ""))[0] is not None


def _names(found: comparison.Comparison) -> list[str]:
    """The measures that any of the results may have, in order."""
    return list(dict.fromkeys(name for c in found.compared for name in c.about.all_measures))


def without(found: comparison.Comparison) -> dict[tuple[str, ...], list[str]]:
    """The measures that no result has, by the reasons that the results give."""
    out: dict[tuple[str, ...], list[str]] = {}
    for name in _names(found):
        reasons = dict.fromkeys(c.about.all_measures[name][1] for c in found.compared if name in c.about.all_measures)
        if any(reasons) and not any(_known(c, name) for c in found.compared):
            out.setdefault(tuple(filter(None, reasons)), []).append(name)
    return out


def _name(one: comparison.Side, language: str) -> str:
    """Return a distinct name of a result, without the person's code."""
    label = visit_name(language, one.about.row.label)
    if len(one.about.results) < 2 or one.about.result is None:
        return label
    return f"{label}, {one.about.result.kind}, {one.about.result.methods[0]}"


def _first_cycle(own: Sequence[comparison.Cycle], of_all: Sequence[Sequence[comparison.Cycle]]) -> int | None:
    """The place of the cycle that is shown at first: in the middle of those of one side, the same side for all."""
    side = max(("right", "left"), key=lambda s: sum(any(c.side == s for c in cycles) for cycles in of_all))
    mine = [i for i, c in enumerate(own) if c.side == side] or list(range(len(own)))
    return mine[len(mine) // 2] if mine else None


def _bounds(limits: tuple[float, float] | None, decimals: int) -> str:
    return "" if limits is None else f"{number(limits[0], decimals)}\N{EN DASH}{number(limits[1], decimals)}"


def _read(text: str) -> tuple[int, int | None]:
    """A visit, and which of its results, as an address names it; 0, which no visit has, for anything else."""
    visit, point, result = text.partition(".")
    numbers = whole_number(visit), whole_number(result) if point else None
    if numbers[0] is None or (point and numbers[1] is None):
        return 0, None
    return numbers[0], numbers[1]


def _address(found: comparison.Comparison, reference: int) -> str:
    """The same comparison with another reference."""
    named = [
        f"{c.about.row.session_id}" + ("" if c.about.shown is None else f".{c.about.shown}") for c in found.compared
    ]
    return "/compare?" + urlencode([*(("v", n) for n in named), ("ref", named[reference])])
