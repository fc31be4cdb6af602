"""Long and wide tables of a visit: angles, events, cycles, curves, measures. Units are in the names of columns, or in a
column `unit` next to the values."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from pbl_pipeline.body import SLIDES, angle_of
from pbl_pipeline.fit.angles_file import angles_table
from pbl_pipeline.gait import ANGLE_NAMES, MEASURES, NUMBERS, GaitCycle, GaitMetrics, Gdi, Spatiotemporal, TrialMetrics
from pbl_pipeline.gait import cycle_measures as measures_of
from pbl_pipeline.kinetics import CURVES, CycleKinetics, Kinetics
from pbl_pipeline.records import meanings
from pbl_pipeline.results import Measure
from pbl_pipeline.shipped import shipped_text
from pbl_pipeline.words import KINETICS, unit_of

from .columns import Column, Table, Texts, joined
from .trial import ExportTrial

#: Positive direction of a joint value, by the joint's name without its side.
JOINT_SIGNS: dict[str, str] = json.loads(shipped_text("export/joint_signs.json"))
_SIDES = {"r": "right", "l": "left"}
_STATISTICS = dict(sorted(meanings(Measure).items(), key=lambda named: named[0] != "mean"))
_ONLY_LONG = ("variability", "cv_percent", "asymmetry_percent")
_TRIAL = "name of the trial"


def session_tables(
    trials: Sequence[ExportTrial], metrics: GaitMetrics | None, kinetics: Kinetics | None = None
) -> list[Table]:
    """Make all tables of a visit. Those of gait need measured trials."""
    wide = [_angles_wide(t) for t in trials]
    made = [joined(wide), joined([_angles_long(w, t) for w, t in zip(wide, trials, strict=True)])]
    measured = [(t.name, t.measured) for t in trials if t.measured is not None]
    if measured:
        made.append(joined([_events(name, m) for name, m in measured]))
        forces = {(t.name, c.number): c for t in trials if t.kinetics is not None for c in t.kinetics.cycles}
        index = {(name, c.number, c.side): c.gdi for name, m in measured for c in m.gdi.cycles}
        cycles = [
            _Cycle(name, c, index.get((name, c.number, c.side), np.nan), forces.get((name, c.number)))
            for name, m in measured
            for c in m.cycles
        ]
        pooled = {name for name, m in measured if m.pooled}
        made += [_cycles_wide(cycles, pooled), _cycles_long(cycles), _curves_wide(cycles), _curves_long(cycles)]
        parts = [_Part("trial", name, m.spatiotemporal, m.gdi) for name, m in measured]
        if metrics is not None:
            parts = [_Part("session", "", metrics.spatiotemporal, metrics.gdi, kinetics), *parts]
        made += [_measures_wide(parts), _measures_long(parts)]
    return made


# --------------------------------------------------------------------------------------------------------------- angles
def _angles_wide(trial: ExportTrial) -> Table:
    frame = angles_table(trial.fit)
    columns = _time(trial)
    for joint, values in zip(frame.columns[1:], frame.to_numpy().T[1:] + 0.0, strict=True):
        unit, text = ("m" if joint in SLIDES else "deg"), joint_sign(joint)
        columns.append(Column(f"{joint}_{unit}", values, unit, f"positive: {text}"))
    return Table("angles_wide", tuple(columns))


def _angles_long(wide: Table, trial: ExportTrial) -> Table:
    """Frames with a pose, one joint after the other."""
    fit, seen = trial.fit, np.flatnonzero(trial.known)
    joints = [(c, c.name.removesuffix(f"_{c.unit}")) for c in wide.columns if c.unit in ("deg", "m")]
    n, j = len(seen), len(joints)
    column = {angle: i for i, f in enumerate(fit.joint_names) for angle in (f, angle_of(f)[0])}
    sd = np.asarray(fit.qpos_sd, float)[seen][:, [column[name] for _, name in joints]]
    sd = sd * [1.0 if name in SLIDES else 180.0 / np.pi for _, name in joints]
    base, sides = zip(*(_sided(name) for _, name in joints), strict=True)
    columns = [
        Column("trial", Texts.constant(trial.name, n * j), "", _TRIAL),
        Column("frame", np.tile(seen, j), "", "number of the frame, from 0; those without a pose are left out"),
        Column("time_s", np.tile(np.asarray(fit.time_s, float)[seen], j), "s", "from the first frame of the video"),
        Column("angle", _repeated(base, n), "", "OpenSim's name without the side; signs: see angles_wide"),
        Column("side", _repeated(sides, n), "", "left, right, or empty"),
        Column("value", np.concatenate([np.asarray(c.values)[seen] for c, _ in joints]), "column unit", "joint value"),
        Column("sd", sd.T.ravel(), "column unit", "its standard deviation, where the fit knows it"),
        Column("unit", _repeated([c.unit for c, _ in joints], n), "", "deg or m"),
    ]
    return Table("angles_long", tuple(columns))


def _time(trial: ExportTrial) -> list[Column]:
    n = len(trial.fit.time_s)
    return [
        Column("trial", Texts.constant(trial.name, n), "", _TRIAL),
        Column("frame", np.arange(n), "", "number of the frame, from 0"),
        Column("time_s", np.asarray(trial.fit.time_s, float), "s", "from the first frame of the video"),
    ]


def _sided(joint: str) -> tuple[str, str]:
    """ "hip_flexion_r" -> ("hip_flexion", "right"); joints without a side -> (name, "")."""
    base, _, end = joint.rpartition("_")
    return (base, _SIDES[end]) if end in _SIDES else (joint, "")


def joint_sign(joint: str) -> str:
    """Return the positive direction of a joint value."""
    return JOINT_SIGNS.get(_sided(joint)[0], "")


def _repeated(texts: Sequence[str], n: int) -> Texts:
    one = Texts.of(texts)
    return Texts(np.repeat(one.codes, n), one.texts)


# ----------------------------------------------------------------------------------------------------- events, cycles
def _events(name: str, measured: TrialMetrics) -> Table:
    found = measured.events.events
    columns = [
        Column("trial", Texts.constant(name, len(found)), "", _TRIAL),
        Column("time_s", _floats(e.time_s for e in found), "s", "from the first frame of the video"),
        Column("side", Texts.of([e.side for e in found]), "", "left or right"),
        Column("event", Texts.of([e.event for e in found]), "", "foot_down: initial contact; foot_up: toe-off"),
        Column("probability", _floats(e.probability for e in found), "", "that it is real, 0 to 1 (docs/events.md)"),
        Column("bout", _integers(e.bout for e in found), "", "number of the walking bout, from 0"),
    ]
    return Table("events", tuple(columns))


class _Cycle(NamedTuple):
    trial: str
    cycle: GaitCycle
    gdi: float
    forces: CycleKinetics | None


def _cycle_keys(cycles: Sequence[tuple[str, GaitCycle]], each: int = 1) -> list[Column]:
    return [
        Column("trial", _repeated([n for n, _ in cycles], each), "", _TRIAL),
        Column("cycle", np.repeat(np.array([c.number for _, c in cycles], np.int64), each), "", "number in its trial"),
        Column("side", _repeated([c.side for _, c in cycles], each), "", "left or right"),
        Column("used", np.repeat([c.used for _, c in cycles], each).astype(bool), "", "part of the measures"),
    ]


def _cycles_wide(cycles: Sequence[_Cycle], pooled: Collection[str]) -> Table:
    """`pooled`: names of the trials whose cycles are pooled for the measures of the visit."""
    values = [measures_of(c.cycle) for c in cycles]
    meant = meanings(GaitCycle)
    columns = _cycle_keys([c[:2] for c in cycles])
    columns.append(Column("bout", _integers(c.cycle.bout for c in cycles), "", "walking bout, from 0"))
    columns += [
        Column(name, _floats(getattr(c.cycle, name) for c in cycles), "s", f"{text}, from the first frame of the video")
        for name, text in meant.items()
        if name.endswith("_s")
    ]
    for name in (m for m in MEASURES if m != "step_time_s"):
        column = _floats(v.get(name, np.nan) for v in values)
        columns.append(Column(name, column, unit_of(name), "of this cycle (docs/measures.md)"))
    columns += [
        Column("gdi", _floats(c.gdi for c in cycles), "", "Gait Deviation Index of the cycle"),
        Column("pooled", np.array([c.trial in pooled for c in cycles], bool), "", "whether the visit pools its trial"),
        Column("far_leg", Texts.of([c.cycle.far_leg for c in cycles]), "", meant["far_leg"]),
        Column("excluded", Texts.of([c.cycle.excluded for c in cycles]), "", "why it is not part of the measures"),
    ]
    for name in KINETICS:
        column = _floats(None if c.forces is None else c.forces.measures.get(name) for c in cycles)
        columns.append(Column(name, column, unit_of(name), "of this cycle (docs/kinetics.md)"))
    return Table("cycles_wide", tuple(columns))


def _cycles_long(cycles: Sequence[_Cycle]) -> Table:
    values = [measures_of(c) | {"gdi": g} | ({} if f is None else dict(f.measures)) for _, c, g, f in cycles]
    found = [
        (n, c, m, v)
        for (n, c, *_), of_cycle in zip(cycles, values, strict=True)
        for m, v in of_cycle.items()
        if np.isfinite(v)
    ]
    columns = _cycle_keys([(n, c) for n, c, _, _ in found])
    columns += [
        Column("measure", Texts.of([m for _, _, m, _ in found]), "", "docs/measures.md, kinetics.md"),
        Column("value", _floats(v for _, _, _, v in found), "column unit", "of this cycle"),
        Column("unit", Texts.of([unit_of(m) for _, _, m, _ in found]), "", "empty: none"),
    ]
    return Table("cycles_long", tuple(columns))


def _curves_wide(cycles: Sequence[_Cycle]) -> Table:
    own = [row for row in cycles if row.cycle.curves]
    n = len(next(iter(own[0].cycle.curves.values()))) if own else 0
    columns = [
        *_cycle_keys([c[:2] for c in own], n),
        Column("percent", np.tile(_percent(n), len(own)), "%", "of the cycle's time"),
    ]
    for angle, text in ANGLE_NAMES.items():
        values = [c.cycle.curves.get(angle, np.full(n, np.nan)) for c in own]
        positive = text.removeprefix("deg, ")
        columns.append(Column(f"{angle}_deg", np.concatenate([*values, np.zeros(0)]), "deg", positive))
    for name in CURVES:
        values = [({} if c.forces is None else c.forces.curves).get(name, np.full(n, np.nan)) for c in own]
        text = "of the own foot or leg (docs/kinetics.md)"
        columns.append(Column(name, np.concatenate([*values, np.zeros(0)]), unit_of(name), text))
    return Table("curves_wide", tuple(columns))


def _curves_long(cycles: Sequence[_Cycle]) -> Table:
    own = [(name, c, angle) for name, c, *_ in cycles for angle in ANGLE_NAMES if angle in c.curves]
    n = len(own[0][1].curves[own[0][2]]) if own else 0
    sd = [c.curves_sd.get(angle, np.full(n, np.nan)) for _, c, angle in own]
    columns = [
        *_cycle_keys([(name, c) for name, c, _ in own], n),
        Column("angle", _repeated([a for _, _, a in own], n), "", "signs: see curves_wide"),
        Column("percent", np.tile(_percent(n), len(own)), "%", "of the cycle's time"),
        Column("value_deg", np.concatenate([*(c.curves[a] for _, c, a in own), np.zeros(0)]), "deg", "angle"),
        Column("sd_deg", np.concatenate([*sd, np.zeros(0)]), "deg", "its standard deviation, where it is known"),
    ]
    return Table("curves_long", tuple(columns))


def _percent(n: int) -> np.ndarray:
    return np.linspace(0.0, 100.0, n)


# ------------------------------------------------------------------------------------------------------------ measures
class _Part(NamedTuple):
    scope: str
    trial: str
    measures: Spatiotemporal
    gdi: Gdi
    kinetics: Kinetics | None = None


#: Statistics of a measure of forces; `KineticMeasure` has `error_sd` as `sd`.
_OF_FORCES = ("mean", "left", "right", "n", "error_sd", "asymmetry_percent")


def _values(part: _Part) -> Iterator[tuple[str, str, float, str]]:
    """Measure, statistic, value and, if there is none, the reason."""
    _, _, spatiotemporal, gdi, kinetics = part
    for name, measure in spatiotemporal.measures.items():
        if measure is None:
            yield name, "mean", np.nan, spatiotemporal.reasons.get(name, "")
            continue
        for statistic in _STATISTICS:
            if (value := getattr(measure, statistic)) is not None:
                yield name, statistic, float(value), ""
    for statistic in (*NUMBERS, "n"):
        value = getattr(gdi, statistic)
        if value is not None:
            yield "gdi", statistic, float(value), ""
        elif statistic == "mean":
            yield "gdi", statistic, np.nan, gdi.reason
    if gdi.profile is not None:
        for side in _SIDES.values():
            yield from (("gvs_" + a + "_deg", side, float(v), "") for a, v in gdi.profile.of_side(side).items())
        scores = (("left", gdi.profile.gps_left), ("right", gdi.profile.gps_right), ("mean", gdi.profile.gps))
        yield from (("gps_deg", statistic, float(v), "") for statistic, v in scores if v is not None)
    if kinetics is None:
        return
    for name in KINETICS:
        measure = kinetics.measures.get(name)
        if measure is None:
            yield name, "mean", np.nan, kinetics.reasons.get(name, "")
            continue
        found = {s: getattr(measure, "sd" if s == "error_sd" else s) for s in _OF_FORCES}
        yield from ((name, s, float(v), "") for s, v in found.items() if v is not None)


def _measures_long(parts: Sequence[_Part]) -> Table:
    found = [(part[0], part[1], *row) for part in parts for row in _values(part)]
    columns = [
        *_scope([(scope, trial) for scope, trial, *_ in found]),
        Column(
            "measure", Texts.of([r[2] for r in found]), "", "docs/measures.md, kinetics.md; gvs: score of one angle"
        ),
        Column("statistic", Texts.of([r[3] for r in found]), "", "mean, left, right, sd, n, ... (docs/measures.md)"),
        Column("value", _floats(r[4] for r in found), "column unit", "missing where it cannot be trusted"),
        Column("unit", Texts.of([_unit(r[2], r[3]) for r in found]), "", "empty: none"),
        Column("reason", Texts.of([r[5] for r in found]), "", "why there is no value"),
    ]
    return Table("measures_long", tuple(columns))


def _measures_wide(parts: Sequence[_Part]) -> Table:
    rows = [{(m, s): v for m, s, v, _ in _values(part)} for part in parts]
    names = dict.fromkeys((*MEASURES, *(m for part in parts for m in part[2].of_task)))
    wanted = [(m, s) for m in names for s in _STATISTICS if s not in _ONLY_LONG]
    wanted += [("gdi", s) for s in (*NUMBERS, "n")]
    wanted += [("gps_deg", s) for s in ("mean", "left", "right")]
    wanted += [(m, s) for m in KINETICS for s in _OF_FORCES]
    columns = _scope([(scope, trial) for scope, trial, *_ in parts])
    for measure, statistic in wanted:
        values = _floats(row.get((measure, statistic), np.nan) for row in rows)
        own = meanings(Gdi) if measure == "gdi" else {}
        text = (_STATISTICS | own).get(statistic, statistic.replace("_", " "))
        columns.append(Column(f"{measure}_{statistic}", values, _unit(measure, statistic), text))
    return Table("measures_wide", tuple(columns))


def _scope(keys: Sequence[tuple[str, str]]) -> list[Column]:
    return [
        Column("scope", Texts.of([s for s, _ in keys]), "", "session: all trials together; trial: one"),
        Column("trial", Texts.of([t for _, t in keys]), "", f"{_TRIAL}, empty for the session"),
    ]


def _unit(measure: str, statistic: str) -> str:
    return {"n": "", "cv_percent": "%", "asymmetry_percent": "%"}.get(statistic, unit_of(measure))


def _integers(values: Iterable[int]) -> np.ndarray:
    return np.array(list(values), np.int64)


def _floats(values: Iterable[float | None]) -> np.ndarray:
    return np.array([np.nan if v is None else v for v in values], float)
