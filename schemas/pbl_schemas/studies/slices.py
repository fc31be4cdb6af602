"""Slices: frozen visits and methods of figures, and their rows as the library's `StudyData`."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.filming import Filming
from pbl_pipeline.names import check_label, is_plain, shortened
from pbl_pipeline.words import UNUSABLE, unit_of

from .. import fit, gait, gdi, lab, session, study, video
from ..datajoint_setup import IntegrityError, dj
from ..decisions.not_usable import unusable
from ..decisions.review_decisions import record
from ..method_names import with_keys
from ..reading.filming import filming_of
from ..reading.frames import cycle_rows, frame_of, newest_sets
from ..reading.slice_rows import slice_row
from ..rows import PART, grouped, insert_in_parts, inside, rows_inside, utc_now
from ..stored_files import file_ref, read_stored
from ..transactions import in_transaction

if TYPE_CHECKING:
    from pbl_pipeline.study import StudyData

#: One kind of recordings and chain of methods; the kind is `slice_kind` in StudySlice.
CHAIN = ("fit_set_kind", "tracking_method", "keypoint_method", "fit_method", "gait_method", "gdi_method", "norm")
#: Columns that came after the first slices were frozen, whose hash they are part of only where they have a value.
_LATER = ("gdi_unshrunk", "gdi_unshrunk_sd")
_SIDES = {"mean": "both", "left": "left", "right": "right"}
_none = functools.partial(PblError, "DB_NOT_FOUND")
_usage = functools.partial(PblError, "USAGE", next_step="see `pbl study slice --help`")


@dataclasses.dataclass(frozen=True)
class Slice:
    """A frozen slice: name, hash, how many visits it has and how many of them count; `visits`: person, visit, and why
    it does not count, empty where it does; those without a role are not in the slice."""

    name: str
    hash: str
    n: int
    n_included: int
    visits: tuple[tuple[str, str, str], ...] = ()


def freeze(
    name: str,
    cohort: str | None = None,
    roles: Sequence[str] = (),
    methods: Mapping[str, str] | None = None,
    event: str = "",
    note: str = "",
    dry_run: bool = False,
) -> Slice:
    """Freeze the visits of a cohort (None: of all people) with the measures that they have now; `dry_run`: only return
    what would be frozen.

    Raises `PblError` USAGE for a name that is taken, labels too long, several chains of methods; DB_NOT_FOUND for an
    unknown cohort, no visits, no measures.

    Parameters
    ----------
    name
        Of the slice; a name is never used for another one.
    roles
        Visits of these roles alone; empty: all.
    methods
        Key of StudySlice (`fit_method`, ...) -> method, where the tables hold several chains.
    event
        The event from which the days of the visits count, such as surgery.
    note
        Shown on the report, with how many people of the cohort have no visit, and why they were excluded.
    """
    for what, text, longest, least in (("slice", name, 32, 1), ("event", event, 64, 0), ("note", note, 1000, 0)):
        check_label(what, text, longest, least)
    if study.StudySlice & {"study_slice": name}:
        raise PblError(
            "USAGE",
            found=f"slice {name!r} is there already",
            expected="a new name: a slice never changes",
            next_step=f"name it {name}-2, or withdraw the old one: pbl study slice {name} --withdraw",
        )
    if cohort is not None and not study.Cohort & {"cohort": cohort}:
        raise _none(
            f"no cohort {cohort!r}", "a row of study.Cohort", "`pbl study import` with the columns cohort, group"
        )

    def work() -> Slice:
        visits = _candidates(cohort, roles)
        chain = _chain(visits, with_keys(methods or {}))
        members = [] if cohort is None else (study.CohortMember & {"cohort": cohort}).to_dicts()
        rows = _decided(visits, chain, members)
        said = shortened(" ".join(filter(None, (note, _absent(visits, members)))), 1000)
        about = {**chain, "study_slice": name, "slice_event": event, "slice_note": said, "cohort": cohort}
        hashes = _hashes(_frames(rows, about))
        digest = _digest(hashes.values())
        listed = zip(rows["subject"], rows["visit"], rows["reason"], strict=True)
        left_out = () if roles else _without_role(cohort)
        made = Slice(name, digest, len(rows), int(rows["included"].sum()), (*listed, *left_out))
        if dry_run:
            return made
        study.StudySlice.insert1(
            {
                **{k: v for k, v in about.items() if k != "fit_set_kind"},
                "slice_kind": chain["fit_set_kind"],
                "slice_roles": list(roles),
                "slice_n": len(rows),
                "slice_hash": digest,
                "slice_code_version": code_version(),
                "slice_created": utc_now(),
            }
        )
        insert_in_parts(
            study.StudySliceVisit,
            (
                {
                    "study_slice": name,
                    "session_id": r["session_id"],
                    "slice_included": r["included"],
                    "slice_reason": r["reason"],
                    "slice_fit_set": r["fit_set"],
                    "slice_visit_hash": hashes[r["subject"], r["visit"]],
                }
                for r in rows.to_dict("records")
            ),
        )
        return made

    return in_transaction(work)


def withdraw(name: str, by: str) -> None:
    """Delete a slice, with a row of Decision that keeps its hash. Raises `PblError` DB_NOT_FOUND for an unknown slice,
    USAGE if rows of another table refer to it."""
    about = slice_row(name)
    key = {"study_slice": name}

    def work() -> None:
        (study.StudySliceVisit & key).delete_quick()
        (study.StudySlice & key).delete_quick()
        record("slice", by, key, {"hash": about["slice_hash"], "visits": int(about["slice_n"])}, {})

    try:
        in_transaction(work)
    except IntegrityError as error:
        raise PblError(
            "USAGE",
            found=f"rows of another table refer to the slice {name!r}: {error}",
            expected="a slice to which nothing refers",
            next_step="keep it, and freeze another one under a new name",
        ) from None


def study_data(name: str, curves: bool = True) -> StudyData:
    """Return the rows of a slice as frames: visits, their inclusion and methods as frozen, values as the tables hold
    them now; the note states how many visits have others than when it was frozen (`changes` names them).

    Set-based except for the curves, whose files are read one by one (`curves` False leaves them out).

    Raises `PblError` DB_NOT_FOUND for an unknown slice; STUDY_INVALID as `StudyData`.
    """
    from pbl_pipeline.study import StudyData, StudyDescription

    about = slice_row(name)
    rows = _frozen(about)
    frames = _frames(rows, about)
    # Without codes: the note goes with what is exported under others.
    n = len(_changes(about, rows, frames))
    changed = f"{n} of its {about['slice_n']} visits have other numbers than when it was frozen." if n else ""
    frames["visits"] = frames["visits"].merge(_recordings(rows, about), how="left", on=["subject", "visit"])
    if curves:
        frames |= _in_parts(_curves, rows, about)
    description = StudyDescription(
        name=name,
        hash=about["slice_hash"],
        methods={k: about[k] for k in CHAIN if about[k] is not None},
        code_version=about["slice_code_version"],
        event=about["slice_event"],
        note=" ".join(filter(None, (about["slice_note"], changed))),
    )
    return StudyData(**frames, description=description)


def _recordings(rows: Any, about: Mapping[str, Any]) -> Any:
    """Return for each visit how its pooled recordings were filmed, and the numbers of its videos and of those marked as
    not usable, with the reasons. Not part of the frozen hash."""
    import pandas as pd

    chain = {k: about[k] for k in ("fit_set_kind", "fit_method", "gait_method", "gdi_method")}
    with_set = rows[rows["fit_set"] != ""]
    results = [
        {**chain, "session_id": int(r["session_id"]), "fit_set": r["fit_set"]} for r in with_set.to_dict("records")
    ]
    filmed = dict(zip(with_set["session_id"], filming_of(results), strict=True))
    of_visits = rows_inside(video.Video.proj("session_id"), "session_id", map(int, rows["session_id"]))
    own = grouped((int(row["session_id"]), int(row["video_id"])) for row in of_visits)
    marked = {n: UNUSABLE[mark.reason] for n, mark in unusable(v for of in own.values() for v in of).items()}
    out = []
    for row in rows.to_dict("records"):
        videos = own.get(int(row["session_id"]), [])
        reasons = Counter(marked[v] for v in videos if v in marked)
        how = filmed.get(row["session_id"], Filming())
        parts = {"views": how.views, "cameras": how.cameras, "pictures": how.pictures, "height": how.height}
        out.append(
            {
                "subject": row["subject"],
                "visit": row["visit"],
                **{name: ", ".join(words) for name, words in parts.items()},
                "videos": len(videos),
                "videos_left_out": reasons.total(),
                "videos_left_out_why": "; ".join(f"{reason} ({n})" for reason, n in reasons.items()),
            }
        )
    return pd.DataFrame(out)


def changes(name: str) -> list[str]:
    """Return in words which rows of a slice changed since it was frozen; empty if the same frames come out. Raises
    `PblError` DB_NOT_FOUND for an unknown slice."""
    about = slice_row(name)
    rows = _frozen(about)
    return _changes(about, rows, _frames(rows, about) if len(rows) else {})


def _changes(about: Mapping[str, Any], rows: Any, frames: Mapping[str, Any]) -> list[str]:
    out = ["a visit was deleted"] * (about["slice_n"] - len(rows))
    hashes = _hashes(frames) if frames else {}
    for r in rows.to_dict("records"):
        if hashes[r["subject"], r["visit"]] != r["frozen_hash"]:
            out.append(f"visit {r['visit']} of {r['subject']} has other rows")
    return out


# ------------------------------------------------------------------------------------------------------------ freezing
def _candidates(cohort: str | None, roles: Sequence[str]) -> Any:
    visits = study.Visit.proj("visit_role", "visit_days") * session.Session.proj(
        "subject", "session_label", "session_date"
    )
    if cohort is not None:
        visits = visits & (study.CohortMember & {"cohort": cohort}).proj()
    if roles:
        visits = visits & [{"visit_role": r} for r in roles]
    found = frame_of(visits).sort_values(["subject", "session_date", "session_id"], ignore_index=True)
    if not len(found):
        raise _none("no visit", "visits of the cohort with these roles", "`pbl study import` visits")
    return found


def _without_role(cohort: str | None) -> list[tuple[str, str, str]]:
    """Visits that cannot be in a slice, because no role is stated."""
    visits = session.Session - study.Visit.proj()
    if cohort is not None:
        visits &= (study.CohortMember & {"cohort": cohort}).proj()
    rows = visits.to_dicts(order_by="subject, session_label")
    return [(row["subject"], row["session_label"], "no role is stated") for row in rows]


def _chain(visits: Any, methods: Mapping[str, str]) -> dict[str, str | None]:
    """The one kind of recordings and chain of methods by which the visits are measured; None for tracking and keypoints
    of markers."""
    if unknown := sorted(set(methods) - set(CHAIN)):
        raise _usage(f"methods of {', '.join(unknown)}", f"of {', '.join(CHAIN)}")
    found = {tuple(row[c] for c in CHAIN): row for row in _measured(visits, methods)}
    if not found:
        raise _none("no measures of these visits", "visits with measures", "`pbl populate`, `pbl status`")
    if len(found) > 1:
        named = sorted(", ".join(method or fit.LABORATORY for method in chain) for chain in found)
        raise _usage(
            f"measures of {len(found)} chains of methods: " + "; ".join(named[:4]),
            f"one: name the method of one or more of {', '.join(CHAIN)}",
        )
    return dict(zip(CHAIN, *found, strict=True))


def _measured(visits: Any, methods: Mapping[str, str | None]) -> list[dict[str, Any]]:
    """SessionGdi of the current sets of the visits by these methods, with session and chain."""
    sets = newest_sets()
    of_set = dj.U("fit_set", "tracking_method", "keypoint_method") & fit.FitSet.Video
    columns = ("session_status", "session_reason", "session_gdi_reason")
    measured = sets * of_set * gdi.SessionGdi.proj(*columns) & dict(methods)
    return rows_inside(measured, "session_id", map(int, visits["session_id"]))


def _decided(visits: Any, chain: Mapping[str, str | None], members: Sequence[Mapping[str, Any]]) -> Any:
    """The visits with their set of videos, and whether each counts."""
    left_out = {m["subject"]: m["member_reason"] for m in members if not m["member_included"]}
    measured = {int(r["session_id"]): r for r in _measured(visits, chain)}
    taken: set[tuple[str, str]] = set()
    rows = []
    for v in visits.to_dict("records"):
        row, role = measured.get(int(v["session_id"])), (v["subject"], v["visit_role"])
        if v["subject"] in left_out:
            reason = left_out[v["subject"]] or "excluded from the cohort"
        elif row is None:
            reason = "no measures"
        elif row["session_status"] != "PASS":
            reason = row["session_reason"] or "no gait cycle"
        elif role in taken:
            reason = f"the person has an earlier visit of the role {v['visit_role']}"
        else:
            reason = ""
            taken.add(role)
        rows.append((row["fit_set"] if row else "", not reason, _line(reason)))
    fit_set, included, reasons = zip(*rows, strict=True)
    columns = {"session_label": "visit", "visit_role": "role", "visit_days": "days"}
    return visits.rename(columns=columns).assign(fit_set=fit_set, included=included, reason=reasons)


def _absent(visits: Any, members: Sequence[Mapping[str, Any]]) -> str:
    """A sentence on the people of a cohort who have none of the visits; "" if there are none."""
    there = set(visits["subject"])
    absent = [m for m in members if m["subject"] not in there]
    if not absent:
        return ""
    reasons = Counter(m["member_reason"] or "no reason stated" for m in absent if not m["member_included"])
    why = ", ".join(f"{n} excluded: {reason}" for reason, n in sorted(reasons.items()))
    said = f"{len(absent)} of {len(members)} people of the cohort have none of these visits"
    return _line(f"{said} ({why})" if why else said) + "."


def _line(text: str) -> str:
    text = " ".join(text.split())
    return shortened(text if is_plain(text) else ascii(text), 200)


# ------------------------------------------------------------------------------------------------------------- reading
def _frozen(about: Mapping[str, Any]) -> Any:
    own = study.StudySliceVisit & {"study_slice": about["study_slice"]}
    named = session.Session.proj("subject", visit="session_label", date="session_date")
    rows = frame_of(own * named * study.Visit.proj(role="visit_role", days="visit_days"))
    rows = rows.sort_values(["subject", "date", "session_id"], ignore_index=True)
    names = {"slice_included": "included", "slice_reason": "reason", "slice_fit_set": "fit_set"}
    return rows.rename(columns={**names, "slice_visit_hash": "frozen_hash"})


def _frames(rows: Any, about: Mapping[str, Any]) -> dict[str, Any]:
    """visits, measures, scores, instruments and cycles of the visits `rows` by the chain of `about`."""
    frames = _in_parts(_frames_of, rows, about)
    return {**frames, "instruments": frames["instruments"].drop_duplicates("instrument", ignore_index=True)}


def _in_parts(read: Callable[[Any, Mapping[str, Any]], dict[str, Any]], rows: Any, about: Mapping[str, Any]) -> Any:
    """The frames that `read` returns of the visits `rows`, `PART` visits at a time."""
    import pandas as pd

    found = [read(rows.iloc[i : i + PART], about) for i in range(0, max(len(rows), 1), PART)]
    return {name: pd.concat([frames[name] for frames in found], ignore_index=True) for name in found[0]}


def _frames_of(rows: Any, about: Mapping[str, Any]) -> dict[str, Any]:
    ids = inside("session_id", map(int, rows["session_id"]))
    chain = {k: about[k] for k in gdi.SessionGdi.primary_key if k in CHAIN}
    key = rows[["session_id", "subject", "visit"]]
    sets = rows.loc[rows["fit_set"] != "", ["fit_set", "session_id", "subject", "visit"]]
    of_sets = inside("fit_set", sets["fit_set"])

    index = (gdi.SessionGdi & chain & of_sets).proj(
        "session_gdi_left", "session_gdi_right", "session_gps", "session_gps_left", "session_gps_right",
        gdi="session_gdi", gdi_sd="session_gdi_sd", n_cycles="session_gdi_n",
        gdi_unshrunk="session_gdi_unshrunk", gdi_unshrunk_sd="session_gdi_unshrunk_sd",
    )  # fmt: skip
    index = frame_of(index)
    more = ("intervention", "intervention_date", "assistive_device", "orthosis", "visit_age")
    people = session.Session.proj("subject", date="session_date") * lab.Subject.proj("population")
    visit = frame_of(study.Visit.proj(*more) * people & ids).drop(columns="subject")
    visits = rows[[*key, "role", "days", "included", "reason", "fit_set"]].merge(visit, on="session_id")
    found = ["fit_set", "gdi", "gdi_sd", "gdi_unshrunk", "gdi_unshrunk_sd", "n_cycles"]
    visits = visits.merge(index[found], how="left", on="fit_set")
    visits["group"] = _groups(visits, about.get("cohort"))
    visits = visits.sort_values(["subject", "date", "session_id"], ignore_index=True)
    visits = visits.drop(columns=["session_id", "fit_set"]).rename(columns={"visit_age": "age"})

    scores = frame_of(study.ClinicalScore & ids).merge(key, on="session_id")
    instruments = frame_of(study.ClinicalInstrument & (study.ClinicalScore & ids).proj("instrument"))
    named = instruments.rename(columns=lambda c: c.removeprefix("instrument_").replace("minimal_change", "mic"))
    sources = [
        shortened("; ".join(filter(None, (a, f"minimal important change: {b}" if b else ""))), 200)
        for a, b in zip(instruments["instrument_source"], instruments["minimal_change_source"], strict=True)
    ]
    wanted = ["instrument", "unit", "low", "high", "higher_is_better", "ordinal", "mic", "classes", "mic_classes"]
    cycles = cycle_rows(fit.FitSelection.proj() * fit.FitSet.proj("session_id") & of_sets, chain)
    return {
        "visits": visits,
        "measures": _measures(sets, index, chain, of_sets),
        "scores": scores.rename(columns={"score_value": "value"})[["subject", "visit", "instrument", "value"]],
        "instruments": named[wanted].assign(source=sources),
        "cycles": _cycles(cycles, sets, about["gdi_method"]),
    }


def _groups(visits: Any, cohort: str | None) -> Any:
    """Return for each visit the person's group in the cohort, else the population."""
    if cohort is None:
        return visits["population"]
    members = study.CohortMember & {"cohort": cohort} & "member_group != ''"
    groups = {r["subject"]: r["member_group"] for r in members.to_dicts()}
    return visits["subject"].map(groups).astype(object).fillna(visits["population"])


def _measures(sets: Any, index: Any, chain: Mapping[str, str], of_sets: Any) -> Any:
    """Long: measures of both sides and of each, the index and the Gait Profile Score of a side."""
    import pandas as pd

    own = frame_of(gdi.SessionGdi.Measure & chain & of_sets)
    rows = own.rename(columns={"session_measure": "measure", "session_measure_n": "n_cycles"})
    parts = []
    for column, side in _SIDES.items():
        part = rows.assign(side=side, value=rows[f"session_measure_{column}"].astype(float), sd=np.nan)
        if side == "both":
            part["sd"] = rows["session_measure_sd"].astype(float)
        else:
            part["n_cycles"] = np.nan
        parts.append(part[["fit_set", "side", "measure", "value", "sd", "n_cycles"]])
    for measure, column in (("gdi", "session_gdi"), ("gps_deg", "session_gps")):
        for side in ("left", "right", *(("both",) if measure == "gps_deg" else ())):
            name = column if side == "both" else f"{column}_{side}"
            one = index.assign(side=side, measure=measure, value=index[name].astype(float), sd=np.nan)
            parts.append(one[["fit_set", "side", "measure", "value", "sd", "n_cycles"]])
    long = pd.concat(parts, ignore_index=True).dropna(subset=["value"])
    long["unit"] = [unit_of(m) for m in long["measure"]]
    return long.merge(sets, on="fit_set").drop(columns=["fit_set", "session_id"])


def _cycles(cycles: Any, sets: Any, gdi_method: str) -> Any:
    """Long: index, stride time and stride length of each cycle that the visit pools, numbered by visit and side."""
    from pbl_pipeline.gait import ANY_PACE

    pace = gdi.pace_of(gdi_method)
    kept = cycles[(cycles["pool"] != "") if pace == ANY_PACE else (cycles["pool"] == pace)]
    kept = kept.merge(sets, on=["fit_set", "session_id"]).sort_values(["subject", "visit", "video_id", "cycle_no"])
    kept = kept.assign(
        side=kept["cycle_side"],
        cycle=kept.groupby(["subject", "visit", "cycle_side"]).cumcount() + 1,
        gdi=kept["cycle_gdi"],
        stride_time_s=kept["cycle_end"] - kept["cycle_start"],
        stride_length_m=kept["cycle_stride_length"].astype(float),
    )
    names = ["gdi", "stride_time_s", "stride_length_m"]
    keys = ["subject", "visit", "side", "cycle"]
    long = kept[[*keys, *names]].melt(keys, names, "measure", "value")
    return long.dropna(subset=["value"])


def _curves(rows: Any, about: Mapping[str, Any]) -> dict[str, Any]:
    """Mean curve of the used cycles that each visit pools, per side and angle, at 0, 1, ..., 100 %."""
    import pandas as pd

    from pbl_pipeline.gait.metrics_file import load_curves
    from pbl_pipeline.study import CURVE_PERCENT, CURVE_POINTS

    of = rows.loc[rows["fit_set"] != ""].set_index("fit_set")
    of_sets = inside("fit_set", of.index)
    chain = {k: about[k] for k in ("fit_method", "gait_method")}
    done = video.conditions(fit.FitSet.Video & of_sets)
    pace = gdi.pace_of(about["gdi_method"])
    used: dict[tuple[str, int], dict[int, str]] = defaultdict(dict)
    for r in (gait.GaitCycle.Cycle & chain & of_sets & {"cycle_used": True}).proj("cycle_side").to_dicts():
        used[r["fit_set"], int(r["video_id"])][int(r["cycle_no"])] = r["cycle_side"]
    found: dict[tuple[str, str, str], list[np.ndarray]] = defaultdict(list)
    for r in (gait.GaitCycle & chain & of_sets).to_dicts(order_by="KEY"):
        number = int(r["video_id"])
        sides = used[r["fit_set"], number]
        if not sides or not done[number].pooled(pace):
            continue
        by_cycle = read_stored(file_ref(r["curves"]), load_curves)
        for n, side in sides.items():
            for angle, curve in by_cycle[n].curves.items():
                found[r["fit_set"], side, angle].append(curve)
    out, points = [], []
    for (fit_set, side, angle), curves in found.items():
        mean = np.mean(curves, axis=0, dtype=float)
        points.append(np.interp(CURVE_PERCENT, np.linspace(0.0, 100.0, len(mean)), mean))
        out.append((of.at[fit_set, "subject"], of.at[fit_set, "visit"], side, angle, "deg", len(curves)))
    frame = pd.DataFrame(out, columns=["subject", "visit", "side", "variable", "unit", "n_cycles"])
    values = pd.DataFrame(np.array(points).reshape(len(out), len(CURVE_POINTS)), columns=list(CURVE_POINTS))
    return {"curves": frame.join(values)}


# --------------------------------------------------------------------------------------------------------------- hashes
def _hashes(frames: Mapping[str, Any]) -> dict[tuple[str, str], str]:
    """(subject, visit) -> hash over all rows of the visit in these frames, in any order."""
    lines: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name in ("visits", "measures", "scores", "cycles"):
        frame = frames[name]
        columns = sorted(set(frame.columns) - {"subject", "visit"})
        # The same text for a number whatever the type of its column, which depends on other rows.
        plain = frame[columns].apply(lambda c: c.map(_text))
        later = [c for c in columns if c in _LATER]
        added = ["\t".join(f"{c} {v}" for c, v in r.items() if v) for r in plain[later].to_dict("records")]
        texts = plain.drop(columns=later).to_numpy()
        for key, row, more in zip(zip(frame["subject"], frame["visit"], strict=True), texts, added, strict=True):
            lines[key].append("\t".join((name, *row, *([more] if more else []))))
    return {key: _digest(texts) for key, texts in lines.items()}


def _text(value: Any) -> str:
    if value is None or value != value:  # NaN, NaT
        return ""
    if isinstance(value, (bool, np.bool_)):
        return str(int(value))
    return f"{float(value):.10g}" if isinstance(value, (int, float, np.number)) else str(value)


def _digest(texts: Any) -> str:
    return hashlib.sha256("\n".join(sorted(texts)).encode()).hexdigest()[:16]
