"""Charts and pictures of the report."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from markupsafe import Markup

from pbl_pipeline import charts
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import GaitCycle, GaitEvents, NormalBands, leg_angles
from pbl_pipeline.gait.events import SIDES
from pbl_pipeline.render import SIDE_COLOUR, stance_spans
from pbl_pipeline.report.curves import Ranges, cycle_curves
from pbl_pipeline.report.words import plural
from pbl_pipeline.runs import runs
from pbl_pipeline.words import ANGLES, FOOT_ANGLES, PELVIS_ANGLES, number


@dataclasses.dataclass(frozen=True)
class Picture:
    """One frame with the fitted body drawn over it, from `render.overlay_frames`: (H, W, 3) uint8 BGR."""

    index: int
    time_s: float
    image: np.ndarray


_JPEG_QUALITY = 84


def cycle_charts(cycles: Sequence[GaitCycle], bands: NormalBands) -> list[dict]:
    """Draw one chart per angle over the used cycles: the joints first, then the pelvis. Empty without curves."""
    return [
        {
            "name": curve.title,
            "note": ", ".join(x for x in (curve.positive, "" if curve.norm is not None else "no norm") if x),
            "svg": curve.picture,
        }
        for curve in cycle_curves(cycles, bands, ANGLES | FOOT_ANGLES | PELVIS_ANGLES, _cycle_label)
    ]


def _cycle_label(title: str, ranges: Ranges) -> str:
    told = (f"{s} {number(low, 0)} to {number(high, 0)}\N{DEGREE SIGN}" for s, (low, high) in ranges.items())
    return f"{title} in degrees over the gait cycle in percent. Mean curves: {', '.join(told)}."


def time_charts(fit: TrialFit, events: GaitEvents | None) -> list[dict]:
    """Draw the joint angles over the recording. Empty if the body was fitted in no frame."""
    if not np.isfinite(fit.qpos).any():
        return []
    sides = leg_angles(fit)
    spans = {s: stance_spans(events.events, s) for s in SIDES} if events is not None else {}
    drawn = []
    for name, (title, positive) in ANGLES.items():
        curves = {side: sides[side][name] for side in SIDES if name in sides[side]}
        label = f"{title} in degrees over the {fit.time_s[-1]:.1f} seconds of the recording."
        drawn.append({"name": title, "note": positive, "svg": charts.time_chart(label, fit.time_s, curves, spans)})
    return drawn


def contact_chart(fit: TrialFit, events: GaitEvents) -> Markup | None:
    """Draw the foot contacts over the recording; None without events."""
    if not events.events:
        return None
    n = {side: [len(events.times(side, kind)) for kind in ("foot_down", "foot_up")] for side in SIDES}
    counts = ", ".join(f"{side} {down} initial contacts and {up} toe-offs" for side, (down, up) in n.items())
    return charts.contact_chart(
        f"Foot contacts over the recording: {counts}.",
        float(fit.time_s[-1]),
        known_spans(fit),
        {s: stance_spans(events.events, s) for s in SIDES},
        [(e.time_s, e.side, e.event) for e in events.events],
    )


def known_spans(fit: TrialFit) -> list[tuple[float, float]]:
    """Spans (start, stop) in s in which the body is fitted."""
    known = np.isfinite(np.asarray(fit.qpos, float)).all(axis=1)
    return [(float(fit.time_s[run][0]), float(fit.time_s[run][-1])) for run in runs(known)]


def index_chart(values: dict[str, list[float]], title: str) -> Markup | None:
    """Draw the index of each cycle; None without any."""
    if not any(values.values()):
        return None
    means = ", ".join(
        f"{side} mean {np.mean(v):.1f} of {plural(len(v), 'cycle')}" for side, v in values.items() if len(v)
    )
    return charts.index_chart(f"{title} per cycle: {means}.", values)


def picture(trial: str, p: Picture) -> dict:
    """Encode an overlay frame as a data URI with its texts."""
    _, data = cv2.imencode(".jpg", p.image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return {
        "src": "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode(),
        "alt": f"Frame {p.index} of {trial} with the fitted body drawn over the person",
        "width": p.image.shape[1],
        "height": p.image.shape[0],
        "caption": f"{number(p.time_s, 2)} s (frame {p.index})",
    }


def legend(*items: str) -> list[tuple[Markup, str]]:
    """Legend of a chart: samples of lines and areas with their texts, by the names "left", "norm", ..."""
    left, right = SIDE_COLOUR["left"], SIDE_COLOUR["right"]
    samples = {
        "left": (_line(left, 2.4, "7 3"), "Left"),
        "right": (_line(right, 2.4), "Right"),
        "cycles": (_line(right, 0.9, opacity=0.5), "Single cycles"),
        "norm": (_rect("#dfe3e8"), "Norm, mean and one sd each way"),
        "foot off": (_line("#5b636c", 1.0, "2 3"), "Foot off"),
        "stance": (_rect(right, 0.45), "Foot on the ground"),
        "initial contact": (Markup('<polygon points="10,1 20,1 15,10" fill="#5b636c"/>'), "Initial contact"),
        "toe-off": (Markup('<polygon points="10,11 20,11 15,2" fill="#5b636c"/>'), "Toe-off"),
        "in view": (_rect("#eceff2"), "Person in view and fitted"),
    }
    return [
        (Markup('<svg viewBox="0 0 30 12" aria-hidden="true">{}</svg>').format(samples[i][0]), samples[i][1])
        for i in items
    ]


def _line(colour: str, width: float, dash: str = "none", opacity: float = 1.0) -> Markup:
    return Markup(
        '<line x1="0" y1="6" x2="30" y2="6" stroke="{}" stroke-width="{}" stroke-dasharray="{}" stroke-opacity="{}"/>'
    ).format(colour, width, dash, opacity)


def _rect(colour: str, opacity: float = 1.0) -> Markup:
    return Markup('<rect x="0" y="1" width="30" height="10" fill="{}" fill-opacity="{}"/>').format(colour, opacity)
