"""Filming conditions of the walks of a visit, and their differences between two visits, which must be filmed alike."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable

from pbl_pipeline.texts import code_of

#: Kinds of sets of recordings, which are never fitted, pooled or averaged with one another: videos of one camera each,
#: trials of several calibrated cameras, marker recordings.
KINDS = SINGLE, RIG, MARKERS = "single", "rig", "markers"
#: Least fraction of a recording's cycles that makes a side a view (a turn at the end is not one), and that makes front
#: or back one: a pass along the camera's axis begins and ends obliquely.
SIDE_SHARE, FRONT_SHARE = 0.25, 0.5
#: The view from the front or the back, in which neither leg is behind the other.
FRONT_OR_BACK = "front_or_back"
VIEW = "view"
#: Properties that `differences` compares, in its order.
WHAT = ("aid", "orthosis", "pace", "height", "camera", "picture", VIEW)
#: Lowest number of pixels of the shorter side of a picture, and what such pictures are called.
_PICTURES = ((1400, "2160p"), (900, "1080p"), (600, "720p"), (0, "480p"))
#: Leg that is behind the other -> side from which it is filmed.
FILMED_FROM = {"right": "left", "left": "right"}


@dataclasses.dataclass(frozen=True)
class Filming:
    """Filming conditions of the pooled walks of a visit. Each field is sorted, and empty if it is not known.

    views: sides from which one camera saw the person, "left", "right" and `FRONT_OR_BACK`; aid, orthosis: codes or
    words as stated of the visit, "none" where it is stated that there was none; paces: of the walks; height: whether
    the body height was stated ("stated" or "not_stated"), or "depths", which set the scale then; cameras: kinds of
    sources of the intrinsics (`video.CAMERA_KINDS`); pictures: classes of the size of the picture, such as "1080p";
    far_leg: the leg behind the other in most cycles (`gait.far_leg_of`).
    """

    views: tuple[str, ...] = ()
    aid: tuple[str, ...] = ()
    orthosis: tuple[str, ...] = ()
    paces: tuple[str, ...] = ()
    height: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    pictures: tuple[str, ...] = ()
    far_leg: str = ""


@dataclasses.dataclass(frozen=True)
class Difference:
    """A property, one of `WHAT`, that differs between two visits, with its values now and before."""

    what: str
    now: tuple[str, ...] = ()
    before: tuple[str, ...] = ()

    def __str__(self) -> str:
        values = f" ({', '.join(self.now) or 'not stated'}, before: {', '.join(self.before) or 'not stated'})"
        return self.what + (values if self.now or self.before else "")


def differences(now: Filming, before: Filming) -> tuple[Difference, ...]:
    """Return the differences in how two visits were filmed. A property that is unknown in one of them is not compared,
    except that an aid or orthosis (not that there was none) stated in one visit alone is a difference."""
    pairs = zip(WHAT, _compared(now), _compared(before), strict=True)
    return tuple(
        Difference(what, a, b)
        for what, a, b in pairs
        if a != b and ((a and b) or (what in ("aid", "orthosis") and (a or b) != ("none",)))
    )


def stated(kind: str, text: str) -> tuple[str, ...]:
    """Return the code of an "aid" or "orthosis" as stated of a visit, or its words; empty where nothing is stated."""
    word = " ".join(code_of(kind, text).split()).lower()
    return (word,) if word else ()


def height_word(height_m: float | None, with_depths: bool) -> str:
    """Return the word of `Filming.height` for the body height that a fit was told (m; None or NaN for none), and
    whether it had depths."""
    if with_depths:
        return "depths"
    return "not_stated" if height_m is None or math.isnan(height_m) else "stated"


def picture_class(width_px: float, height_px: float) -> str:
    """Return the class of the size of a picture, such as "1080p", by its shorter side; empty where it is not known."""
    shorter = min(width_px, height_px)
    return next(name for lowest, name in _PICTURES if shorter >= lowest) if shorter > 0 else ""


def views_of(cycles: Iterable[tuple[str | int, str]]) -> tuple[str, ...]:
    """Return the sides from which a person was seen.

    cycles: recording and `GaitCycle.far_leg` of each used cycle.
    """
    counts = Counter(cycles)
    of_recording: Counter[str | int] = Counter()
    for (recording, _), n in counts.items():
        of_recording[recording] += n
    enough = {
        far
        for (recording, far), n in counts.items()
        if n >= (SIDE_SHARE if far else FRONT_SHARE) * of_recording[recording]
    }
    return known(FILMED_FROM.get(far, FRONT_OR_BACK) for far in enough)


def known(words: Iterable[str]) -> tuple[str, ...]:
    """Return the words that are not empty, each once and sorted."""
    return tuple(sorted({w for w in words if w}))


def _compared(filming: Filming) -> tuple[tuple[str, ...], ...]:
    f = filming
    return f.aid, f.orthosis, f.paces, f.height, f.cameras, f.pictures, f.views
