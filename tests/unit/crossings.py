"""People who cross, hide and come back, as a detector would report them: for tests of identity."""

import dataclasses
from collections.abc import Callable

import numpy as np

from pbl_pipeline.models import box_iou
from pbl_pipeline.tracking import AssociationParams, Detection, JoinParams, UncrossParams, body_box
from pbl_pipeline.tracking.associate import Associator, Trail
from pbl_pipeline.tracking.identity_swaps import undo_swaps
from pbl_pipeline.tracking.reidentify import join_trails

SIZE = (1920, 1080)
#: Nearer than so many body heights, the noise decides which detection is whose, and nothing follows from it.
MET = 0.3
#: Appearances of three people: bins of a histogram twice over, as of `appearance_of` (parts that sum to 1).
_N = 2 * (6 + 64)


def clothes(seed: int) -> np.ndarray:
    """A look (140,) that is unlike those of other seeds."""
    rng = np.random.default_rng(1000 + seed)
    parts = [rng.dirichlet(np.full(n, 0.15)) for n in (6, 64, 6, 64)]
    return np.concatenate(parts)


@dataclasses.dataclass(frozen=True)
class Walker:
    """Body circle's centre x(t) (px), its height in the picture, when it is in view, and the clothes."""

    x: Callable[[float], float]
    height: float = 400.0
    y: float = 540.0
    seen: Callable[[float], bool] = lambda t: True
    appearance: np.ndarray | None = None


def scene(
    walkers: list[Walker], seconds: float, seed: int = 0, hide: float = 0.5, noise: float = 0.015
) -> list[tuple[float, list[tuple[int | None, Detection]]]]:
    """Times with the detections and whose each is, None where two bodies are one behind the other.

    Later walkers stand in front: who is covered by more than `hide` of the own box by one in front is not detected.
    `noise` of place, in body heights; of size twice that.

    The times are those of `Watch`: every 0.2 s, and every second frame at 30 Hz where two are close.
    """
    rng = np.random.default_rng(seed)
    out = []
    times = [0.0]
    while times[-1] < seconds - 1e-9:
        places = [(w.x(times[-1]), w.height) for w in walkers if w.seen(times[-1])]
        close = any(abs(a - b) < 0.6 * np.sqrt(h * k) for i, (a, h) in enumerate(places) for b, k in places[:i])
        times.append(times[-1] + (2 / 30 if close else 0.2))
    for t in times:
        found: list[tuple[int | None, Detection]] = []
        for who, w in enumerate(walkers):
            centre = w.x(float(t))
            if not w.seen(float(t)) or not 0 < centre < SIZE[0]:
                continue
            height = w.height * np.exp(rng.normal(0, 2 * noise))
            place = np.array([centre, w.y]) + rng.normal(0, noise * w.height, 2)
            roi = np.array([*place, height, rng.normal(0, 0.03)])
            box = body_box(roi)
            front = [body_box(np.array([v.x(float(t)), v.y, v.height, 0.0])) for v in walkers[who + 1 :]]
            if any(_covered(box, f) > hide for f in front):
                continue
            look = None if w.appearance is None else w.appearance * np.exp(rng.normal(0, 0.2, _N))
            others = [v.x(float(t)) for v in walkers if v is not w and v.seen(float(t))]
            met = any(abs(o - centre) < MET * w.height for o in others)
            found.append((None if met else who, Detection(box, 0.95, roi, look)))
        order = rng.permutation(len(found))
        out.append((float(t), [found[i] for i in order]))
    return out


def identities(frames: list[tuple[float, list[tuple[int | None, Detection]]]]) -> list[list[int]]:
    """For each track that comes out, whose detections it holds, in order of time.

    What counts is who comes out of an encounter as whom: detections within it are of nobody.
    """
    associator = Associator(AssociationParams())
    owner = {}
    for i, (t, found) in enumerate(frames):
        for who, d in found:
            owner[id(d)] = who
        for new in associator.step(i, t, [d for _, d in found]):
            associator.begin(Trail.of(i, t, new))
    real = [t for t in associator.trails() if len(t.frames) >= 3]
    people = join_trails(undo_swaps(real, UncrossParams()), SIZE, JoinParams())
    return [[k for d in p.detections if (k := owner[id(d)]) is not None] for p in people]


def _covered(box: np.ndarray, front: np.ndarray) -> float:
    iou = float(box_iou(box, front[None])[0])
    areas = [np.prod(b[2:] - b[:2]) for b in (box, front)]
    return iou * sum(areas) / (1 + iou) / areas[0]
