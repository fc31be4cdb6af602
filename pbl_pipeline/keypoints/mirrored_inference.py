"""Inference of a picture and of its mirror image, combined into one result.

The errors of the two are partly independent, and if one prefers one side of the body the mirrored one prefers the
other: their mean is better than either (research/reports). Half their difference changes slowly, so frames that
follow each other closely can share the two inferences: one is seen as it is, the next mirrored, and half the difference
is taken from the frames around. That takes one inference per frame instead of two.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import Akima1DInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.special import expit

from pbl_pipeline.sampling import interval_of

from .flips import leg_points, mirror_of
from .types import PersonKeypoints

#: The sides of the two results are taken as exchanged if their mean distance is more than the first (a fraction of the
#: region's side), and with sides exchanged less than the second as a fraction of that.
LEAST_APART, MOST_CROSSED = 0.05, 0.5
#: Factor of the confidence then.
UNDECIDED = 0.5
#: Longest gap over which inferences are shared.
_MAX_GAP_S = 0.25
#: Standard deviation of the Gaussian over time that smooths half the difference of shared inferences.
_SMOOTH_S = 0.15
#: Weight in it of a point whose two results contradict each other.
_LEAST_WEIGHT = 1e-3


@dataclasses.dataclass(frozen=True)
class MirroredInference:
    """Combines the two results for points `names`.

    confidence = the mean of both, times 1 / (1 + exp((sigma - agree_mm) / agree_width_mm)); sigma is half the 3D
    distance in mm between them. If a network takes one leg for the other its confidence stays near 1, but this factor
    is small.

    If the two are one body with left and right exchanged, of the legs or of the rest, the mirrored points are renamed
    (the mean would be a body without width) and their confidence is halved: the movement decides later which of the two
    is right (`exchange_sides`).
    """

    names: tuple[str, ...]
    agree_mm: float
    agree_width_mm: float

    def averaged(self, own: PersonKeypoints, mirrored: PersonKeypoints) -> PersonKeypoints:
        """Combine the results of one frame and of its mirror image, both in coordinates of the frame."""
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
        """Combine the results of frames with one inference each, those of `mirrored` (T,) bool of the mirror image.
        Frames without the person are ignored; a stretch with fewer than two inferences of either kind is unchanged."""
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
        """(J,) index into `other_px` (J, 2) for each point of `xy_px` (J, 2): the same, or that of the other side if
        the legs, or the rest of the body, are clearly closer with left and right exchanged. `side_px`: the region's."""
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

        Half the difference in a frame is that of its result to the interpolated one of the other kind. Before and after
        the frames of `both` one kind is not known, and that of the nearest of them is used.
        """
        plain = _between(people, ~mirrored, time_s)
        crossed = np.zeros((len(people), len(self.names)), bool)
        for i in np.flatnonzero(mirrored & both):
            same = self.same_sides(plain[i].xy_px, people[i].xy_px, float(people[i].roi_px[2]))
            people[i], crossed[i] = _renamed(people[i], same), same != np.arange(len(same))
        other = _between(people, mirrored, time_s)
        # A frame without the mirror image is as undecided as its neighbours.
        crossed[1:-1] |= ~mirrored[1:-1, None] & (crossed[:-2] | crossed[2:])
        pairs = list(zip(plain, other, strict=True))
        nearest = np.clip(np.arange(len(people)), np.flatnonzero(both)[0], np.flatnonzero(both)[-1])
        agree = np.array([self._agreement(p, m) for p, m in pairs])[nearest]
        stated = np.array([(p.confidence + m.confidence) / 2 for p, m in pairs])
        confidence = np.clip(stated, 0.0, 1.0) * agree * np.where(crossed, UNDECIDED, 1.0)
        weight = both[:, None, None] * np.maximum(agree, _LEAST_WEIGHT)[..., None]
        sd_frames = _SMOOTH_S / interval_of(time_s)

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
    """Frames between the first and the last of `known`; none if there are fewer than two."""
    rows = np.flatnonzero(known)
    out = np.zeros(len(known), bool)
    if len(rows) > 1:
        out[rows[0] : rows[-1] + 1] = True
    return out


def _between(people: Sequence[PersonKeypoints], known: np.ndarray, time_s: np.ndarray) -> list[PersonKeypoints]:
    """Points of each frame, interpolated from the frames of `known`: cubic (Akima) in between, the nearest beyond."""
    at = np.clip(time_s, time_s[known][0], time_s[known][-1])

    def values(name: str) -> np.ndarray:
        every = np.array([getattr(p, name) for p in people])
        return Akima1DInterpolator(time_s[known], every[known], axis=0, method="makima")(at)

    columns = {name: values(name) for name in ("xy_px", "xyz_cam_m", "confidence")}
    return [
        dataclasses.replace(p, **{name: column[i] for name, column in columns.items()}) for i, p in enumerate(people)
    ]
