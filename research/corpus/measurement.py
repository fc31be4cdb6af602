"""`python -m research.corpus.measurement`: the measurement model of the index from passes whose truth is known.

The passes are those of `research.corpus.passes`. Everything is estimated on the persons who are not held out, and
judged on those who are.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import pandas as pd

from pbl_pipeline.fit import METHODS
from pbl_pipeline.gait import MEASURES, Z90, GaitCycle, load_norm, passes_of, score_gdi
from pbl_pipeline.gait.events import LEFT, RIGHT
from pbl_pipeline.gait.events import METHODS as EVENT_METHODS
from pbl_pipeline.gait.measurement import (
    IMPORTANT_CHANGE,
    RIDGE,
    MeasureError,
    MeasurementModel,
    Pass,
    View,
    chances,
    change_sd,
    load_model,
    measure_error,
)
from pbl_pipeline.gait.normative import DEFAULT_NORM, NormativeSet
from pbl_pipeline.results.measures import minimal_change_of
from research.corpus.passes import ANGLES, PASSES, SESSIONS, STEP_DEG
from research.corpus.walks import ANYWHERE, HEALTHY, THERE_AND_BACK

#: The leg behind the other, by view of the corpus; of the views that are left out it differs.
FAR_LEG = {"sagittal": RIGHT, "sagittal_right": LEFT, "frontal": "", "rear": "", "oblique": ""}
MIRRORED = {"sagittal": "sagittal_right", "sagittal_right": "sagittal"}
OTHER = {LEFT: RIGHT, RIGHT: LEFT, "": ""}
#: Least variance (deg^2) of a pass' error in any direction.
LEAST = 1.0
#: Groups of persons who are left out in turn.
FOLDS = 5
#: How a pass was fitted.
ALONE, TOGETHER = "fitted alone", "fitted together"


@dataclasses.dataclass(frozen=True)
class Seen:
    """A recording: whose, its cycles and the passes that the index makes of them, and the true scores (2, K)."""

    person: str
    held_out: bool
    source: str
    condition: str
    severity: float
    view: str
    visit: int
    session: tuple[str, int]  # that it was fitted in: kind (of `SESSIONS`) and number
    cycles: tuple[GaitCycle, ...]
    passes: tuple[Pass, ...]
    true: np.ndarray
    within: np.ndarray  # (K, K) sum of squares of the cycles' scores about their side's mean
    measures: np.ndarray  # (2, M) of `gait.MEASURES`, found and true
    angles: np.ndarray  # (2, 2, 3, 2) deg: found and true, left and right, `ANGLES`, mean and range of the mean curve

    @property
    def walk(self) -> tuple[str, str, float]:
        return self.person, self.condition, self.severity

    @property
    def alone(self) -> bool:
        """True if it was fitted alone."""
        return sum(SESSIONS[self.session[0]].values()) == 1

    @property
    def turns(self) -> bool:
        """True if not all of its cycles have the same leg behind the other."""
        return len({c.far_leg for c in self.cycles}) > 1

    def mirrored(self) -> Seen:
        """The same recording of the mirrored person."""
        return dataclasses.replace(
            self,
            angles=self.angles[:, ::-1],
            view=MIRRORED.get(self.view, self.view),
            passes=tuple(_mirrored(p) for p in self.passes),
            true=self.true[::-1],
        )


def _mirrored(seen: Pass) -> Pass:
    (left, right), (n_left, n_right) = seen.scores, seen.n_cycles
    return Pass((right, left), (n_right, n_left), OTHER[seen.far_leg])


def read_passes(folder: Path, norm: NormativeSet) -> list[Seen]:
    """The recordings of all `passes-*.npz` of a folder and those in it that have cycles of both sides."""
    out = []
    for path in sorted(folder.rglob("*.npz")):
        with np.load(path, allow_pickle=False) as file:
            data = dict(file)
        columns = zip(_scores(data, "detected", norm), _scores(data, "true", norm), strict=True)
        angles = list(zip(_angles(data, "detected"), _angles(data, "true"), strict=True))
        cycles = list(_cycles(data))
        for i, (found, true) in enumerate(columns):
            if min(map(len, found)) == 0 or min(map(len, true)) == 0:
                continue
            passes = passes_of(cycles[i], norm)
            off = np.concatenate([side - side.mean(axis=0) for side in found])
            out.append(
                Seen(
                    str(data["person"][i]),
                    bool(data["held_out"][i]),
                    str(data["source"][i]),
                    str(data["condition"][i]),
                    float(data["severity"][i]),
                    str(data["view"][i]),
                    int(data["visit"][i]),
                    (str(data["session"][i]), int(data["number"][i])),
                    cycles[i],
                    tuple(passes),
                    np.array([side.mean(axis=0) for side in true]),
                    off.T @ off,
                    np.array([data["measures"][i], data["true_measures"][i]]),
                    np.array(angles[i]),
                )
            )
    return out


def _cycles(data: dict[str, np.ndarray]) -> Iterator[tuple[GaitCycle, ...]]:
    """Return the used cycles of each recording, by which `score_gdi` knows it."""
    ends = np.cumsum(data["detected_curves_n"])[:-1]
    columns = (np.split(data[f"detected_{k}"], ends) for k in ("curves", "right", "far_leg"))
    for i, (curves, right, far_leg) in enumerate(zip(*columns, strict=True)):
        name = f"{data['view'][i]} {data['recording'][i]}"
        yield tuple(
            GaitCycle(
                name, k, 0, RIGHT if right[k] else LEFT, 0.0, 0.0, 0.0, 0.0, 1.0,
                curves=dict(zip(ANGLES, curves[k] * STEP_DEG, strict=True)), far_leg=str(far_leg[k]),
            )
            for k in range(len(curves))
        )  # fmt: skip


def _scores(data: dict[str, np.ndarray], kind: str, norm: NormativeSet) -> Iterator[list[np.ndarray]]:
    """Return for each pass the scores (N, K) of the cycles of the left and of the right side."""
    percent = np.linspace(0.0, 100.0, 51)
    curves = data[f"{kind}_curves"] * STEP_DEG
    at = np.array([np.concatenate([np.interp(norm.percent, percent, a) for a in c]) for c in curves])
    scores = norm.scores(at.reshape(-1, len(ANGLES) * len(norm.percent)))
    ends = np.cumsum(data[f"{kind}_curves_n"])
    for part, right in zip(np.split(scores, ends[:-1]), np.split(data[f"{kind}_right"], ends[:-1]), strict=True):
        yield [part[~right], part[right]]


def _angles(data: dict[str, np.ndarray], kind: str) -> Iterator[np.ndarray]:
    """Return for each pass (2, 3, 2) deg: of the mean curve of the left and the right side, each angle's mean and
    range; NaN where a side has no cycle."""
    ends = np.cumsum(data[f"{kind}_curves_n"])[:-1]
    parts = zip(np.split(data[f"{kind}_curves"] * STEP_DEG, ends), np.split(data[f"{kind}_right"], ends), strict=True)
    for curves, right in parts:
        means = [curves[own].mean(axis=0) if own.any() else np.full((3, 51), np.nan) for own in (~right, right)]
        yield np.array([np.stack([m.mean(axis=1), np.ptp(m, axis=1)], axis=1) for m in means])


def fit_model(seen: Sequence[Seen], norm: NormativeSet, fits: Sequence[str], widening: float = 1.0) -> MeasurementModel:
    """Bias and gain of each view by ridge regression of the error on the true scores, and the rest's variance
    components by the means of products of two passes of a walk: of different views `person`; of one view at two visits
    `person` and `view`; of different views in one fit `person` and `visit`; of a pass with itself all. Mirrored passes
    count as well: left and right are alike. Of passes fitted alone `visit` is 0."""
    both = [
        (s, p, i >= len(seen))
        for i, s in enumerate([*seen, *(s.mirrored() for s in seen)])
        for p in s.passes
        if min(p.n_cycles) > 0
    ]
    true = np.array([s.true.ravel() for s, _, _ in both])
    found = np.array([np.concatenate(p.scores) for _, p, _ in both])
    far_legs = np.array([p.far_leg for _, p, _ in both])
    mean, spread = true.mean(axis=0), np.cov(true.T)
    terms: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for far_leg in ("", LEFT):
        own = far_legs == far_leg
        off, error = true[own] - mean, (found - true)[own]
        about = error.mean(axis=0)
        slope = np.linalg.solve(off.T @ off + RIDGE * len(off) * np.eye(len(mean)), off.T @ (error - about))
        terms[far_leg] = about - slope.T @ off.mean(axis=0), slope.T
    half = len(mean) // 2
    terms[RIGHT] = np.roll(terms[LEFT][0], half), np.roll(terms[LEFT][1], (half, half), axis=(0, 1))
    by_walk: dict[tuple, list[tuple[Seen, str, np.ndarray]]] = {}
    for (s, p, mirrored), y, x in zip(both, found, true, strict=True):
        bias, slope = terms[p.far_leg]
        by_walk.setdefault((s.walk, mirrored), []).append((s, p.far_leg, y - x - bias - slope @ (x - mean)))
    products: dict[tuple[str, str], list[np.ndarray]] = {}
    for group in by_walk.values():
        for (a, of_a, x), (b, of_b, y) in itertools.combinations(group, 2):
            of_one_fit = (a.visit, a.session) == (b.visit, b.session)
            if a is b:
                continue  # two directions of one recording
            if of_one_fit and of_a != of_b:
                products.setdefault(("visit", ""), []).append(_symmetric(x, y))
            elif a.visit == b.visit and not (a.alone and b.alone):
                continue  # the same recordings are in several fits
            elif of_a != of_b:
                products.setdefault(("person", ""), []).append(_symmetric(x, y))
            elif a.visit != b.visit:
                products.setdefault(("view", of_a), []).append(_symmetric(x, y))
        for _, far_leg, x in group:
            products.setdefault(("all", far_leg), []).append(np.outer(x, x))
    person = _positive(np.mean(products["person", ""], axis=0))
    common = products.get(("visit", ""), [person])
    visit = _positive(np.mean(common, axis=0) - person)
    views = {}
    for far_leg in ("", LEFT):
        bias, slope = terms[far_leg]
        view = _positive(np.mean(products["view", far_leg], axis=0) - person)
        anew = _positive(np.mean(products["all", far_leg], axis=0) - person - visit - view) + LEAST * np.eye(len(mean))
        views[far_leg] = View(bias, np.eye(len(mean)) + slope, view, anew)
    freedom = sum(len(s.cycles) - 2 for s in seen)
    n_cycles = [n for _, p, _ in both for n in p.n_cycles]
    return MeasurementModel(
        "",
        norm.name,
        tuple(fits),
        mean,
        spread,
        person,
        visit,
        views | {RIGHT: views[LEFT].mirrored()},
        np.sum([s.within for s in seen], axis=0) / freedom,
        float(np.median(n_cycles)),
        widening,
        EVENT_METHODS.find().paramset.hash,
        float(np.median([len(s.cycles) for s in seen])),
        {far_leg: parts_of_errors([s for s in seen if far_leg_of_view(s) == bool(far_leg)]) for far_leg in ("", LEFT)},
    )


def far_leg_of_view(seen: Seen) -> bool | None:
    """Return True for a view from a side, False for one from the front, the back or between; None for one that differs
    between recordings or in one."""
    return None if seen.view in (ANYWHERE, THERE_AND_BACK) else FAR_LEG[seen.view] != ""


def parts_of_errors(seen: Sequence[Seen]) -> dict[str, MeasureError]:
    """The parts of each measure's error: means of products of the errors of two passes of a walk in one view. Where no
    walk has the measure at two visits (lengths need a phone that stands), the bias alone lasts."""
    by_walk: dict[tuple, list[tuple[int, np.ndarray]]] = {}
    for s in seen:
        by_walk.setdefault((s.walk, s.view), []).append((s.visit, s.measures[0] - s.measures[1]))
    all_ = np.array([e for group in by_walk.values() for _, e in group])
    pairs: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for group in by_walk.values():
        for (i, x), (j, y) in itertools.combinations(group, 2):
            pairs[i == j].append(x * y)
    out = {}
    for k, name in enumerate(MEASURES):
        errors, same, other = (
            v[np.isfinite(v)] for v in (all_[:, k], *(np.array(pairs[b])[:, k] for b in (True, False)))
        )
        if len(errors) < 10 or not len(same):
            continue
        lasting = max(float(other.mean()), 0.0) if len(other) else float(errors.mean()) ** 2
        visit = max(float(same.mean()) - lasting, 0.0)
        anew = max(float((errors**2).mean()) - lasting - visit, 0.0)
        out[name] = MeasureError(*(float(np.sqrt(v)) for v in (lasting, visit, anew)))
    return out


def _symmetric(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    product = np.outer(x, y)
    return (product + product.T) / 2


def _positive(matrix: np.ndarray) -> np.ndarray:
    """The nearest covariance."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def sessions_of(seen: Iterable[Seen]) -> Iterator[tuple[str, int, list[Seen]]]:
    """Sessions of the passes of one visit: kind, visit, passes. Those that were fitted together, and all that passes
    fitted alone make."""
    visits: dict[tuple, dict[str, list[Seen]]] = {}
    together: dict[tuple, list[Seen]] = {}
    for s in seen:
        if s.alone:
            visits.setdefault((s.walk, s.visit), {}).setdefault(s.view, []).append(s)
        else:
            together.setdefault((s.walk, s.visit, s.session), []).append(s)
    for (_, visit), views in visits.items():
        for kind, wanted in SESSIONS.items():
            for first in range(PASSES + 1 - max(wanted.values())):
                passes = [views.get(v, [])[first : first + n] for v, n in wanted.items()]
                if all(len(p) == n for p, n in zip(passes, wanted.values(), strict=True)):
                    yield kind, visit, [s for p in passes for s in p]
    for (_, visit, (kind, _)), passes in together.items():
        if len(passes) == sum(SESSIONS[kind].values()):
            yield kind, visit, passes


def judged(seen: Iterable[Seen], model: MeasurementModel, norm: NormativeSet) -> pd.DataFrame:
    """A row per session: whose, the true index, and what `score_gdi` says of all its cycles."""
    rows = []
    for kind, visit, recordings in sessions_of(seen):
        found = score_gdi([c for s in recordings for c in s.cycles], norm, error_model=model)
        true = np.mean([s.true for s in recordings], axis=0)
        first = recordings[0]
        rows.append(
            {
                "kind": kind,
                "passes": len(recordings),
                **{n: getattr(first, n) for n in ("person", "held_out", "source", "condition", "severity")},
                "visit": visit,
                "turns": any(s.turns for s in recordings),
                "true": norm.index_of_scores(true).mean(),
                "found": found.mean,
                "sd": found.sd,
                "sd_anew": (found.minimal_change or np.nan) / minimal_change_of(1.0),
                "unshrunk": found.unshrunk,
                "unshrunk_sd": found.unshrunk_sd,
                "disagree": any(c.check == "passes_agree" and c.advice for c in found.qc),
            }
        )
    return pd.DataFrame(rows)


def error_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Per kind of session: bias, sd and rms of the error; of the unshrunk index beside it, with its slope on the true
    one among healthy walks; the fraction of 90 % intervals that hold the truth, and of visits whose passes are said to
    disagree; the fraction of pairs of visits without a change that lie within the minimal one."""
    rows: list[dict[str, Any]] = []
    single = frame[frame["passes"] == 1]
    groups = [("all", frame), ("far leg changes", frame[frame["turns"]]), ("one pass, any view", single)]
    groups = [(name, group) for name, group in groups if len(group)]
    for name, group in [*groups, *frame.groupby("kind", sort=False)]:
        off, unshrunk = group["found"] - group["true"], group["unshrunk"] - group["true"]
        healthy = group[group["condition"] == HEALTHY]
        keys = ["kind", "person", "condition", "severity"]
        visits: Any = group.groupby([*keys, "visit"])[["found", "sd_anew"]].first().unstack("visit").dropna()
        apart = (visits["found"][0] - visits["found"][1]).abs()
        least = Z90 * np.sqrt(visits["sd_anew"][0] ** 2 + visits["sd_anew"][1] ** 2)
        rows.append(
            {
                "session": name,
                "n": len(group),
                "bias": off.mean(),
                "sd": off.std(),
                "rms": float(np.sqrt((off**2).mean())),
                "unshrunk bias": unshrunk.mean(),
                "unshrunk sd": unshrunk.std(),
                "stated": group["unshrunk_sd"].mean(),
                "slope": np.polyfit(healthy["true"], healthy["unshrunk"], 1)[0] if len(healthy) > 2 else np.nan,
                "disagree": group["disagree"].mean(),
                "recorded bias": off[group["source"] == "recorded"].mean(),
                "mean sd": group["sd"].mean(),
                "in 90 %": (off.abs() <= Z90 * group["sd"]).mean(),
                "unchanged within": (apart <= least).mean(),
                "minimal change": least.mean(),
            }
        )
    return pd.DataFrame(rows)


def lasting_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Parts of the index's error by kind of session, as standard deviations: what all walks of a person have in common,
    bias included, what both visits of a walk have in common beside it, and what is drawn anew at each. More passes of a
    kind lessen the last alone. Means of products of two errors, as in `fit_model`."""
    keys = ["person", "condition", "severity"]
    rows = []
    kinds: Any = frame.assign(off=frame["found"] - frame["true"]).groupby("kind", sort=False)
    for kind, own in kinds:
        visits: Any = own.groupby([*keys, "visit"])["off"].mean().unstack("visit").dropna()
        of_person = own.groupby(keys)["off"].mean().groupby("person")
        n, total, squares = of_person.size(), of_person.sum(), of_person.agg(lambda v: (v**2).sum())
        several = n > 1
        person = np.average(((total**2 - squares) / (n * (n - 1)))[several], weights=n[several])
        walk = (visits[0] * visits[1]).mean() - person
        parts = np.array([person, walk, (own["off"] ** 2).mean() - person - walk])
        rows.append({"session": kind, **dict(zip(("person", "walk", "anew"), np.sqrt(parts.clip(0.0)), strict=True))})
    return pd.DataFrame(rows)


def change_table(frame: pd.DataFrame) -> pd.DataFrame:
    """Return, of the true change of synthetic people between healthy and the severest impairment, the fraction that is
    found, by impairment and kind of session; impairments that change the index by less than 3 points in the mean are
    left out."""
    keys = ["kind", "person"]
    own: Any = frame[frame["source"] == "synthetic"]
    healthy: Any = own[own["condition"].isin(["", HEALTHY])].groupby(keys)[["found", "unshrunk", "true"]].mean()
    severe: Any = own[own["severity"] == own["severity"].max()]
    change: Any = severe.groupby(["condition", *keys])[["found", "unshrunk", "true"]].mean() - healthy
    total: Any = change.dropna().groupby(["kind", "condition"]).mean()
    total = total[total["true"].abs() >= 3.0]
    share: Any = pd.DataFrame({n: total[n] / total["true"] for n in ("found", "unshrunk")})
    return share.unstack("kind")


def change_pairs(frame: pd.DataFrame) -> pd.DataFrame:
    """Each walk of a person at the first visit with each of theirs at the second, by the same kind of session, or one
    from the left and one from the front: found and true change, and the standard deviations that are known of it."""
    keys = ["kind", "person", "condition", "severity", "visit"]
    one: Any = frame.groupby(keys).first().reset_index()
    rows = []
    for _, own in one.groupby("person"):
        for a, b in itertools.product(*(own[own["visit"] == v].to_dict("records") for v in (0, 1))):
            same_view = a["kind"] == b["kind"]
            if not same_view and (a["kind"], b["kind"]) != ("left", "front"):
                continue
            whole = a["sd"], b["sd"]
            least = Z90 * np.sqrt(2.0) * np.array([a["sd_anew"], b["sd_anew"]])
            by = b["found"] - a["found"]
            rows.append(
                {
                    "kind": a["kind"] if same_view else "left, then front",
                    "unchanged": (a["condition"], a["severity"]) == (b["condition"], b["severity"]),
                    "found": by,
                    "true": b["true"] - a["true"],
                    "anew": np.hypot(a["sd_anew"], b["sd_anew"]) if same_view else np.hypot(*whole),
                    "whole": np.hypot(*whole),
                    "sd": change_sd((least[0], least[1]), whole) if same_view else float(np.hypot(*whole)),
                }
            )
    return pd.DataFrame(rows)


def remains_table(pairs: pd.DataFrame) -> pd.DataFrame:
    """Logarithmic loss of both probabilities by how much of what two visits have in common does not cancel
    (`gait.measurement.REMAINS`), over pairs that were filmed alike and that changed, and their mean absolute true
    change (`USUAL_CHANGE`)."""
    own = pairs[(pairs["kind"] != "left, then front") & ~pairs["unchanged"]]
    rows = []
    for share in np.arange(0.0, 1.01, 0.1):
        sd = np.sqrt(own["anew"] ** 2 + share * (own["whole"] ** 2 - own["anew"] ** 2))
        losses = {}
        said = np.array([chances(*v, IMPORTANT_CHANGE) for v in zip(own["found"], sd, strict=True)])
        for column, limit in enumerate((0.0, IMPORTANT_CHANGE)):
            p = np.clip(said[:, column], 1e-9, 1 - 1e-9)
            real = own["true"] * np.sign(own["found"]) > limit
            losses[f"beyond {limit:.0f}"] = -np.log(np.where(real, p, 1 - p)).mean()
        changed = float(np.mean(np.abs(own["true"])))
        rows.append({"remains": share, **losses, "sum": sum(losses.values()), "mean change": changed})
    return pd.DataFrame(rows)


def _stated(pairs: Any) -> np.ndarray:
    """Both probabilities of each change, (N, 2)."""
    return np.array([chances(by, sd, IMPORTANT_CHANGE) for by, sd in zip(pairs["found"], pairs["sd"], strict=True)])


def probability_table(pairs: pd.DataFrame) -> pd.DataFrame:
    """Return for pairs that changed how often the true change goes the way of the found one, and by `IMPORTANT_CHANGE`,
    beside the mean probability that was stated, by stated probability."""
    own = pairs[~pairs["unchanged"] & (pairs["true"].abs() > 0.01)]
    said = _stated(own)
    true = own["true"] * np.sign(own["found"])
    rows = []
    for (low, high), (title, p, real) in itertools.product(
        itertools.pairwise((0.0, 0.05, 0.2, 0.5, 0.65, 0.8, 0.9, 0.95, 0.99, 1.001)),
        (("real", said[:, 0], true > 0), ("important", said[:, 1], true > IMPORTANT_CHANGE)),
    ):
        inside = (p >= low) & (p < high)
        if inside.any():
            stated, found = p[inside].mean(), real[inside].mean()
            rows.append(
                {"of": title, "from": low, "to": min(high, 1.0), "n": inside.sum(), "stated": stated, "found": found}
            )
    return pd.DataFrame(rows).sort_values("of", kind="stable", ascending=False)


def probability_errors(pairs: pd.DataFrame) -> pd.DataFrame:
    """By kind of session: of unchanged pairs how many are called real with at least 0.95 (either way: at most 0.1), and
    of changed ones the Brier score of each probability."""
    rows = []
    for kind, own in [("all", pairs), *pairs.groupby("kind", sort=False)]:
        said = np.array(
            [chances(by, sd, IMPORTANT_CHANGE) for by, sd in zip(own["found"], own["sd"], strict=True)], float
        )
        true, moved = own["true"] * np.sign(own["found"]), ~own["unchanged"]
        rows.append(
            {
                "session": kind,
                "unchanged": int(own["unchanged"].sum()),
                "called real": (said[own["unchanged"], 0] >= 0.95).mean(),
                "changed": int(moved.sum()),
                "Brier, real": ((said[:, 0] - (true > 0)) ** 2)[moved].mean(),
                "Brier, important": ((said[:, 1] - (true > IMPORTANT_CHANGE)) ** 2)[moved].mean(),
                "in 90 %": ((own["found"] - own["true"]).abs() <= Z90 * own["sd"])[moved].mean(),
            }
        )
    return pd.DataFrame(rows)


def stated_errors(seen: Sequence[Seen], model: MeasurementModel) -> pd.DataFrame:
    """Coverage of the stated errors of the gait measures of one pass: the fraction of 90 % intervals that hold the
    truth, and of pairs of two visits in one view within the minimal detectable change."""
    rows = []
    for title, far_leg in (("sides", LEFT), ("front, back", "")):
        own = [s for s in seen if far_leg_of_view(s) == bool(far_leg)]
        for k, name in enumerate(MEASURES):
            held, within, sds = [], [], []
            visits: dict[tuple, dict[int, tuple[float, float]]] = {}
            for s in own:
                stated = measure_error(model, name, len(s.cycles))
                off = s.measures[0, k] - s.measures[1, k]
                if stated is None or not np.isfinite(off):
                    continue
                held.append(abs(off) <= Z90 * stated[0])
                sds.append(stated[0])
                visits.setdefault((s.walk, s.view), {})[s.visit] = off, stated[1]
            for pair in visits.values():
                if len(pair) == 2:
                    (x, a), (y, b) = pair[0], pair[1]
                    within.append(abs(x - y) <= Z90 * np.sqrt(2.0) * max(a, b))
            if held:
                rows.append(
                    {"measure": name, "from": title, "n": len(held), "mean sd": np.mean(sds), "in 90 %": np.mean(held),
                     "unchanged within": np.mean(within) if within else np.nan}
                )  # fmt: skip
    return pd.DataFrame(rows)


def common_errors(seen: Sequence[Seen]) -> pd.DataFrame:
    """Parts that the errors of two passes of each gait measure have in common, as standard deviations: of one walk at
    one visit and at two, in one view and in two, and of two walks of a person at two visits in one view, with the
    fraction of the part of one walk that does not cancel between walks (`gait.measurement.MEASURES_REMAIN`)."""
    products: dict[tuple[str, str], list[np.ndarray]] = {}
    people: dict[str, list[Seen]] = {}
    for s in seen:
        people.setdefault(s.person, []).append(s)
    for own in people.values():
        for a, b in itertools.combinations(own, 2):
            about = (
                "walk" if a.walk == b.walk else "person",
                f"{1 + (a.visit != b.visit)} visit, {1 + (a.view != b.view)} view",
            )
            products.setdefault(about, []).append(np.prod([s.measures[0] - s.measures[1] for s in (a, b)], axis=0))
    columns = {k: pd.DataFrame(v).mean() for k, v in products.items()}
    rows = []
    for k, name in enumerate(MEASURES):
        parts = {what: columns[of, what][k] for of, what in sorted(columns) if of == "walk"}
        other = columns["person", "2 visit, 1 view"][k]
        roots = {what: np.sign(v) * np.sqrt(abs(v)) for what, v in {**parts, "other walk": other}.items()}
        rows.append({"measure": name, **roots, "remains": 1.0 - other / parts["2 visit, 1 view"]})
    return pd.DataFrame(rows)


def angle_errors(seen: Sequence[Seen]) -> pd.DataFrame:
    """Error (deg) of mean and range of each angle's mean curve, of one pass: bias and sd of the leg near to the camera
    and of the one behind it, or of both from front and back."""
    rows = []
    far = {title: [s for s in seen if FAR_LEG.get(s.view) == leg] for title, leg in ((RIGHT, RIGHT), (LEFT, LEFT))}
    errors = {n: np.array([s.angles[0] - s.angles[1] for s in own]) for n, own in far.items()}
    other = np.array([s.angles[0] - s.angles[1] for s in seen if s.view in ("frontal", "rear")])
    groups = {
        "sides, near leg": np.concatenate([errors[RIGHT][:, 0], errors[LEFT][:, 1]]),
        "sides, far leg": np.concatenate([errors[RIGHT][:, 1], errors[LEFT][:, 0]]),
        "front, back": other.reshape(-1, *other.shape[2:]),
    }
    for title, off in groups.items():
        for k, angle in enumerate(ANGLES):
            for j, what in enumerate(("mean", "range")):
                own = off[:, k, j]
                rows.append(
                    {"angle": angle, "of": what, "from": title, "n": len(own), "bias": own.mean(), "sd": own.std()}
                )
    return pd.DataFrame(rows)


def measure_errors(seen: Sequence[Seen]) -> pd.DataFrame:
    """Error of each gait measure of one pass: bias and sd in its unit, and the sd of what two passes of one walk at one
    visit in one view have in common, by where they were filmed from."""
    rows = []
    for title, views in (("sides", ("sagittal", "sagittal_right")), ("front, back", ("frontal", "rear"))):
        own = [s for s in seen if s.view in views]
        off = np.array([s.measures[0] - s.measures[1] for s in own])
        by_walk: dict[tuple, list[np.ndarray]] = {}
        for s, o in zip(own, off, strict=True):
            by_walk.setdefault((s.walk, s.view, s.visit), []).append(o)
        pairs = np.array([p for p in by_walk.values() if len(p) == 2]) - pd.DataFrame(off).mean().to_numpy()
        common = np.sqrt(pd.DataFrame(pairs[:, 0] * pairs[:, 1]).mean().clip(lower=0).to_numpy())
        for k, name in enumerate(MEASURES):
            if np.isfinite(off[:, k]).sum() > 10:
                values = off[:, k]
                rows.append(
                    {"measure": name, "from": title, "n": int(np.isfinite(values).sum()), "bias": np.nanmean(values),
                     "sd": np.nanstd(values), "in common": common[k]}
                )  # fmt: skip
    return pd.DataFrame(rows)


def left_out_in_turn(seen: Sequence[Seen], sessions: Sequence[Seen], norm: NormativeSet) -> pd.DataFrame:
    """Sessions of tuning persons, each judged by a model of what is seen of the others (`judged`), with the error by
    its sd."""
    people = sorted({s.person for s in seen})
    frames = []
    for fold in range(FOLDS):
        out = set(people[fold::FOLDS])
        model = fit_model([s for s in seen if s.person not in out], norm, ())
        frame = judged([s for s in sessions if s.person in out], model, norm)
        frames.append(frame.assign(ratio=(frame["found"] - frame["true"]).abs() / frame["sd"]))
    return pd.concat(frames)


def widening_of(judged_out: pd.DataFrame) -> float:
    """The factor of the sd with which 90 % of the intervals of persons left out in turn hold the truth."""
    return round(float(np.quantile(judged_out["ratio"], 0.9)) / Z90, 2)


def coverage_by_chance(judged_out: pd.DataFrame, widening: float, persons: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how often the 90 % intervals of each person left out hold the truth, in order; and the 5th, 50th and 95th
    percentile of the mean of so many persons drawn from them."""
    rows: Any = judged_out.assign(ok=judged_out["ratio"] <= widening * Z90)
    held = rows.groupby("person")["ok"].mean().to_numpy()
    means = np.random.default_rng(0).choice(held, (5000, persons)).mean(axis=1)
    return np.sort(held), np.quantile(means, [0.05, 0.5, 0.95])


def write_model(model: MeasurementModel, path: Path, made_by: str) -> None:
    """Write a model as the library reads it, to four digits."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return json.loads(json.dumps(value.tolist()), parse_float=lambda t: float(f"{float(t):.4g}"))
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items()}
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            return [float(f"{v:.4g}") for v in value]
        if dataclasses.is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return value

    content = {f.name: plain(getattr(model, f.name)) for f in dataclasses.fields(model)}
    del content["views"][RIGHT]  # that of the left, mirrored
    path.write_text(json.dumps({"made_by": made_by, **content}, separators=(",", ":")) + "\n", encoding="utf-8")


@click.command(epilog="Example: python -m research.corpus.measurement passes --write model.json")
@click.argument("folder", type=click.Path(path_type=Path, exists=True))
@click.option("--norm", default=DEFAULT_NORM, show_default=True, help="Normative set.")
@click.option("--fit", default="blazepose", show_default=True, help="Method the passes were fitted with.")
@click.option("--model", "stored", help="Judge this stored model of passes fitted alone instead of the estimated one.")
@click.option(
    "--write",
    type=click.Path(path_type=Path),
    help="Write the model there; with --model that one, its gait measures anew.",
)
@click.option("--curve", "curves", multiple=True, help="Confidence curve of a detector that the written model is for.")
def main(folder: Path, norm: str, fit: str, stored: str | None, write: Path | None, curves: tuple[str, ...]) -> None:
    """Estimate the model of the passes in FOLDER on the tuning persons, and print its errors on those held out."""
    basis, method = load_norm(norm), METHODS[fit]
    seen = read_passes(folder, basis)
    parts = {
        (title, fitted): [s for s in seen if s.held_out == held and s.alone == (fitted == ALONE)]
        for title, held in (("held out", True), ("tuning", False))
        for fitted in (ALONE, TOGETHER)
    }
    people = [len({s.person for s in parts[title, ALONE]}) for title in ("tuning", "held out")]
    click.echo(f"{method.key}, {people[0]} tuning persons, {people[1]} held out")
    models = {}
    for fitted in (ALONE, TOGETHER):
        if own := parts["tuning", fitted]:
            out = left_out_in_turn(own, own, basis)
            models[fitted] = fit_model(own, basis, [method.hash], widening_of(out))
            click.echo(f"\n{fitted}: {len(own)} passes, {len(parts['held out', fitted])} held out")
            _echo_left_out(out, models[fitted].widening, people[1])
            if fitted == TOGETHER:
                click.echo("\nthe same by models of passes fitted alone")
                out = left_out_in_turn(parts["tuning", ALONE], own, basis)
                _echo_left_out(out, models[ALONE].widening, people[1])
    if stored is not None:
        own = models[ALONE]
        parts_anew = {"events": own.events, "pass_cycles": own.pass_cycles, "measures": own.measures}
        models[ALONE] = dataclasses.replace(load_model(stored), **parts_anew)
    for (title, fitted), part in parts.items():
        if not part:
            continue
        about = f"{title}, {fitted}"
        frame = judged(part, models[fitted], basis)
        _echo(f"{about}: error of the index", error_table(frame))
        if fitted == TOGETHER:
            _echo(f"{about}, by the model of passes fitted alone", error_table(judged(part, models[ALONE], basis)))
        else:
            _echo(f"{about}: gait measures", measure_errors(part), 3)
            _echo(f"{about}: parts of the gait measures' errors that two passes have in common", common_errors(part), 4)
            _echo(f"{about}: angles", angle_errors(part), 1)
            _echo(f"{about}: stated", stated_errors(part, models[ALONE]), 3)
        pairs = change_pairs(frame)
        _echo(f"{about}: which part of what visits have in common remains", remains_table(pairs), 3)
        _echo(f"{about}: probability of a change, as stated and as found", probability_table(pairs), 3)
        _echo(f"{about}: probability of a change, by session", probability_errors(pairs), 3)
        click.echo(f"\n{about}: of a true change is found\n{change_table(frame).to_string(float_format='%.2f')}")
    if write is not None:
        model = dataclasses.replace(models[ALONE], name=write.stem, curves=curves)
        index = f"; index of {load_model(stored).name}" if stored else ""
        write_model(model, write, f"python -m research.corpus.measurement, {method.key}, {people[0]} persons{index}")
        click.echo(f"\n{write}")


def _echo(title: str, table: pd.DataFrame, digits: int = 2) -> None:
    click.echo(f"\n{title}\n{table.to_string(index=False, float_format=f'%.{digits}f')}")


def _echo_left_out(out: pd.DataFrame, widening: float, n_held_out: int) -> None:
    by_person, drawn = coverage_by_chance(out, widening, n_held_out)
    factors = out.groupby("kind")["ratio"].quantile(0.9) / Z90
    click.echo(f"widening {widening}; by session: " + ", ".join(f"{k} {f:.2f}" for k, f in factors.items()))
    click.echo(f"90 % intervals of tuning persons left out in turn hold {np.round(by_person, 2).tolist()}")
    click.echo(
        f"of {n_held_out} persons drawn from these: {drawn[1]:.2f} (90 % of draws: {drawn[0]:.2f} to {drawn[2]:.2f})"
    )
    _echo("tuning persons left out in turn: error of the index", error_table(out.assign(sd=out["sd"] * widening)))
    _echo("tuning persons left out in turn: parts of the error", lasting_table(out))


if __name__ == "__main__":
    main()
