"""Inference of a picture and of its mirror image, combined into one result.

Its errors in the two are partly independent, and where it prefers one side of the body the mirrored answer prefers the
other: their mean is better than either (docs/benchmarks.md). Half their difference changes slowly, so frames that
follow each other closely can share the two inferences: one is seen as it is, the next mirrored, and the half is taken
from the frames around. That costs one inference a frame instead of two.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import Akima1DInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.special import expit

from .flips import leg_points, mirror_of
from .types import PersonKeypoints

#: The two answers are taken to have other sides where they lie apart by more than this fraction of the region's side,
#: in the mean, and by less than half of that with the sides exchanged.
LEAST_APART, MOST_CROSSED = 0.05, 0.5
#: Factor of the confidence there.
UNDECIDED = 0.5
#: Over a longer gap nothing is shared.
_MAX_GAP_S = 0.25
#: Standard deviation of the Gaussian over time that half the difference is smoothed by where inferences are shared.
_SMOOTH_S = 0.15
#: Weight there of a point whose two answers contradict each other.
_LEAST_WEIGHT = 1e-3


@dataclasses.dataclass(frozen=True)
class MirroredInference:
    """Puts the two answers for points `names` together.

    confidence = the mean of both, times 1 / (1 + exp((sigma - agree_mm) / agree_width_mm)); sigma is half the 3D
    distance in mm between the answers. The confidence that a network states stays near 1 where it takes one leg
    for the other; this factor is small there.

    Where the two are one body with left and right exchanged, of the legs or of the rest, the mirrored answer is renamed
    after the other (their mean would be a body without width) and the confidence of these points is halved: which of
    the two is right, the movement says (`exchange_sides`).
    """

    names: tuple[str, ...]
    agree_mm: float
    agree_width_mm: float

    def averaged(self, own: PersonKeypoints, mirrored: PersonKeypoints) -> PersonKeypoints:
        """Of one frame that was looked at twice; both in terms of the frame itself."""
        same = self.same_sides(own.xy_px, mirrored.xy_px, float(own.roi_px[2]))
        other = _renamed(mirrored, same)
        stated, decided = (own.confidence + other.confidence) / 2, same == np.arange(len(same))
        confidence = stated * self._agreement(own, other) * np.where(decided, 1.0, UNDECIDED)
        return dataclasses.replace(
            own,
            xy_px=(own.xy_px + other.xy_px) / 2,
            xyz_cam_m=(own.xyz_cam_m + other.xyz_cam_m) / 2,
            confidence=confidence,
            presence=(own.presence + other.presence) / 2,
            roi_px=(own.roi_px + other.roi_px) / 2,
        )

    def shared(
        self,
        found: Sequence[PersonKeypoints | None],
        mirrored: np.ndarray,
        time_s: np.ndarray,
        min_presence: float,
    ) -> list[PersonKeypoints | None]:
        """Of frames that were looked at once each, those of `mirrored` (T,) bool in the mirror image. Frames in which
        nobody was seen take no part; a stretch with fewer than two inferences of either kind stays as it is."""
        out = list(found)
        seen = np.array([i for i, p in enumerate(found) if p is not None and p.presence >= min_presence], int)
        breaks = np.flatnonzero(np.diff(time_s[seen]) > _MAX_GAP_S) + 1
        for rows in np.split(seen, breaks):
            flags = mirrored[rows]
            both = _spanned(flags) & _spanned(~flags)
            if not both.any():
                continue
            people = [p for i in rows if (p := found[i]) is not None]
            for row, person in zip(rows, self._stretch(people, flags, both, time_s[rows]), strict=True):
                out[row] = person
        return out

    def same_sides(self, xy_px: np.ndarray, other_px: np.ndarray, side_px: float) -> np.ndarray:
        """(J,) which point of `other_px` (J, 2) to compare with each of `xy_px` (J, 2): itself, or that of the other
        side where the legs, or the rest of the body, lie clearly closer with left and right exchanged. `side_px`: the
        region's."""
        order = np.arange(len(self.names))
        mirror = mirror_of(self.names)
        if mirror is None:
            return order
        legs = leg_points(self.names)
        for group in (np.flatnonzero(legs), np.flatnonzero(~legs)):
            apart = np.linalg.norm(xy_px[group] - other_px[group], axis=1).mean()
            crossed = np.linalg.norm(xy_px[group] - other_px[mirror[group]], axis=1).mean()
            if apart > LEAST_APART * side_px and crossed < MOST_CROSSED * apart:
                order[group] = mirror[group]
        return order

    def _stretch(
        self,
        people: list[PersonKeypoints],
        mirrored: np.ndarray,
        both: np.ndarray,
        time_s: np.ndarray,
    ) -> list[PersonKeypoints]:
        """Return the combined results of a stretch.

        Half the difference in a frame is that of its result to the other kind's, interpolated there. Before and after
        the frames of `both` one kind is not known: the nearest of them is used.
        """
        plain = _between(people, ~mirrored, time_s)
        crossed = np.zeros((len(people), len(self.names)), bool)
        for i in np.flatnonzero(mirrored & both):
            same = self.same_sides(plain[i].xy_px, people[i].xy_px, float(people[i].roi_px[2]))
            people[i], crossed[i] = _renamed(people[i], same), same != np.arange(len(same))
        other = _between(people, mirrored, time_s)
        # A frame without the mirrored look is as undecided as those beside it.
        crossed[1:-1] |= ~mirrored[1:-1, None] & (crossed[:-2] | crossed[2:])
        pairs = list(zip(plain, other, strict=True))
        nearest = np.clip(np.arange(len(people)), np.flatnonzero(both)[0], np.flatnonzero(both)[-1])
        agree = np.array([self._agreement(p, m) for p, m in pairs])[nearest]
        stated = np.array([(p.confidence + m.confidence) / 2 for p, m in pairs])
        confidence = np.clip(stated, 0.0, 1.0) * agree * np.where(crossed, UNDECIDED, 1.0)
        weight = both[:, None, None] * np.maximum(agree, _LEAST_WEIGHT)[..., None]
        sd_frames = _SMOOTH_S / float(np.median(np.diff(time_s)))

        def half(name: str) -> np.ndarray:
            apart = np.array([getattr(m, name) - getattr(p, name) for p, m in pairs]) / 2
            summed, total = (gaussian_filter1d(v, sd_frames, axis=0, mode="constant") for v in (weight * apart, weight))
            return np.where(mirrored[:, None, None], -1.0, 1.0) * summed / total

        return [
            dataclasses.replace(person, xy_px=person.xy_px + px, xyz_cam_m=person.xyz_cam_m + m, confidence=c)
            for person, px, m, c in zip(people, half("xy_px"), half("xyz_cam_m"), confidence, strict=True)
        ]

    def _agreement(self, own: PersonKeypoints, other: PersonKeypoints) -> np.ndarray:
        sigma_mm = 500.0 * np.linalg.norm(own.xyz_cam_m - other.xyz_cam_m, axis=1)
        return expit((self.agree_mm - sigma_mm) / self.agree_width_mm)


def _renamed(person: PersonKeypoints, order: np.ndarray) -> PersonKeypoints:
    return dataclasses.replace(
        person,
        xy_px=person.xy_px[order],
        xyz_cam_m=person.xyz_cam_m[order],
        confidence=person.confidence[order],
    )


def _spanned(known: np.ndarray) -> np.ndarray:
    """The frames between the first and the last of `known`; none where there are fewer than two."""
    rows = np.flatnonzero(known)
    out = np.zeros(len(known), bool)
    if len(rows) > 1:
        out[rows[0] : rows[-1] + 1] = True
    return out


def _between(people: Sequence[PersonKeypoints], known: np.ndarray, time_s: np.ndarray) -> list[PersonKeypoints]:
    """Each frame's points as the frames of `known` have them: cubic (Akima) between these, beyond them the nearest."""
    at = np.clip(time_s, time_s[known][0], time_s[known][-1])

    def values(name: str) -> np.ndarray:
        every = np.array([getattr(p, name) for p in people])
        return Akima1DInterpolator(time_s[known], every[known], axis=0, method="makima")(at)

    columns = {name: values(name) for name in ("xy_px", "xyz_cam_m", "confidence")}
    return [
        dataclasses.replace(p, **{name: column[i] for name, column in columns.items()}) for i, p in enumerate(people)
    ]
