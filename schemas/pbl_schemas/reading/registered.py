"""Registered people, visits, videos and methods as frames, a row for each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.change import INDEX, Change, Result, change_of, visit_before
from pbl_pipeline.errors import PblError

from .. import fit, gdi, keypoints, lab, review, session, video
from ..datajoint_setup import dj
from ..decisions.not_usable import unusable
from ..methods import METHOD_TABLES
from ..rows import PART, inside, rows_inside
from .frames import frame_of, newest_sets
from .visit_list import results_of

if TYPE_CHECKING:
    import pandas as pd

    from pbl_pipeline.gait import Measure

#: People whose changes are computed at a time where not all are wanted.
_PEOPLE = 10


def total(name: str, restriction: Any = True) -> int | None:
    """Return how many rows a list (a function of this module) has; None for one that is counted by making it."""
    lists = {"subjects": _people, "visits": _visits, "videos": _videos}
    return len(lists[name]() & restriction) if name in lists else None


def subjects(restriction: Any = True, most: int | None = None) -> pd.DataFrame:
    """One row per person: population, project, how many visits and videos, first and last day (null: no date). `most`:
    so many rows, the first ones; as of the other lists."""
    rows = _first(_people() & restriction, most, "subject")
    visits = session.Session.proj("subject", "session_date")
    counts = {"visits": "count(*)", "first": "min(session_date)", "last": "max(session_date)"}
    recorded = video.Video.proj("session_id") * visits
    return _counted(rows, "subject", (visits, counts), (recorded, {"videos": "count(*)"}))


def visits(restriction: Any = True, most: int | None = None) -> pd.DataFrame:
    """One row per visit: its label and day, how many videos (and marker recordings), and how many results (an index by
    one chain of methods) of its newest set."""
    rows = _first(_visits() & restriction, most, "subject", "session_label")
    recorded = video.Video.proj("session_id"), {"videos": "count(*)"}
    return _counted(rows, "session_id", recorded, (gdi.SessionGdi.proj() * newest_sets(), {"results": "count(*)"}))


def changes(restriction: Any = True, most: int | None = None) -> pd.DataFrame:
    """One row per visit with a visit before (`visit_before`), chain of methods and measure ("gdi": the index): its
    change, the smallest that is more than chance, and the probabilities that it is real and important; or why the two
    cannot be compared (docs/measures.md)."""
    import pandas as pd

    wanted = _visits() & restriction
    people = sorted((dj.U("subject") & wanted).to_arrays("subject"))
    each = len(people) if most is None else _PEOPLE
    out: list[dict[str, Any]] = []
    while people and (most is None or len(out) < most):
        some = wanted if most is None else wanted & inside("subject", people[:each])
        out += _changes(_first(some, None, "subject", "session_date", "session_id"))
        del people[:each]
    columns = ["subject", "visit", "before", *Change(0.0, None).row(""), "fit"]
    return pd.DataFrame(out[:most], columns=columns)


def _changes(found: Any) -> list[dict[str, Any]]:
    """Rows of `changes`. `found`: visits in the order of their people and `visit_before`."""
    results = results_of(found["session_id"])
    measures = _measures(found["session_id"])

    def known(visit: dict, result: Result) -> dict[str, Measure | None]:
        own = measures.get((visit["session_id"], result.kind, *result.methods), {})
        return own if result.index is None else {INDEX: None, **own}

    out: list[dict[str, Any]] = []
    for _, own in found.groupby("subject", sort=False):
        earlier: list[tuple[tuple[str, dict[str, Measure | None]], Result]] = []
        for now in own.to_dict("records"):
            of_visit = [((now["session_label"], known(now, r)), r) for r in results[now["session_id"]]]
            for (label, values), result in of_visit:
                for name, value in values.items():
                    last = visit_before(result, [one for one in earlier if name in one[0][1]])
                    if last is None:
                        continue
                    (before, old), then = last
                    if (change := change_of(name, result, then, value, old[name])) is not None:
                        labels = {"subject": now["subject"], "visit": label, "before": before}
                        out.append({**labels, **change.row(name), "fit": result.methods[0]})
            earlier += of_visit
    return out


def _measures(sessions: Any) -> dict[tuple, dict[str, Measure | None]]:
    """The library's measures of the results of visits, by visit, kind of recordings and methods."""
    chain = ("session_id", "fit_set_kind", *gdi.SessionGdi.primary_key[1:])
    query = gdi.SessionGdi.Measure * newest_sets()
    out: dict[tuple, dict[str, Measure | None]] = {}
    for row in rows_inside(query, "session_id", map(int, sessions)):
        of_visit = out.setdefault(tuple(row[k] for k in chain), {})
        if (measure := gdi.SessionGdi.Measure.measure(row)) is not None:
            of_visit[row["session_measure"]] = measure
    return out


def videos(restriction: Any = True, most: int | None = None) -> pd.DataFrame:
    """One row per video: whose, what is done at which pace, how many methods made keypoints and fits of it, and why it
    is not usable ("" for usable ones)."""
    query = _videos() & restriction
    rows = _first(query, most, "video_id")
    found = video.conditions(query.proj() if most is None else inside("video_id", rows["video_id"]))
    rows["pace"] = rows["video_id"].map({number: about.pace for number, about in found.items()})
    points = keypoints.Keypoints.proj(), {"keypoints": "count(*)"}
    rows = _counted(rows, "video_id", points, (fit.SessionFit.Trial.proj() * newest_sets(), {"fits": "count(*)"}))
    marked = {number: mark.text for number, mark in unusable(rows["video_id"]).items()}
    rows["not_usable"] = [marked.get(int(number), "") for number in rows["video_id"]]
    first = ["video_id", "subject", "session_label", "video_name", "activity", "pace"]
    return rows[[*first, *(c for c in rows.columns if c not in first)]]


def decisions(restriction: Any = True, most: int | None = None) -> pd.DataFrame:
    """One row per decision of a person about a visit or a video, the newest first; its subject, the state before and
    after as JSON."""
    return _of_visits(review.Decision, "decision", restriction, most)


def looks(restriction: Any = True, most: int | None = None) -> pd.DataFrame:
    """One row per look at a recording on the review page (written with PBL_AUDIT_LOOKS alone), the newest first."""
    return _of_visits(review.Viewing, "viewing", restriction, most)


def method_rows(stage: str | None = None) -> pd.DataFrame:
    """One row per method: the stage, its key and short name (which means the newest version), and whether it is the
    stage's default. Raises `PblError` SOLVER_UNKNOWN for an unknown stage."""
    import pandas as pd

    tables = {table.stage: table for table in METHOD_TABLES}
    if stage is not None and stage not in tables:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"stage {stage!r}",
            expected=f"one of {', '.join(tables)}",
            next_step="choose one of these",
        )
    out: list[Mapping[str, Any]] = []
    for name in tables if stage is None else [stage]:
        prefix, known = tables[name].primary_key[0], methods.of_stage(name)
        default = known[known.default].key
        columns = (f"{prefix}_name", f"{prefix}_version")
        for row in tables[name].proj(*columns).to_dicts(order_by=columns):
            about = {"stage": name, "method": row[prefix], "name": row[columns[0]], "version": row[columns[1]]}
            out.append({**about, "default": "yes" if row[prefix] == default else ""})
    return pd.DataFrame(out, columns=["stage", "method", "name", "version", "default"])


def _of_visits(table: Any, prefix: str, restriction: Any, most: int | None) -> pd.DataFrame:
    """Rows about a visit or one of its videos, with whose visit it is, and without a restriction those about none, such
    as an instrument; the columns without their prefix."""
    import pandas as pd

    everything = restriction is True or restriction == {}
    rows = frame_of(table.proj(..., of="session_id") & dj.Top(most if everything else None, f"{prefix}_id DESC"))
    rows["video_id"] = rows["video_id"].astype("Int64")
    own = rows_inside(video.Video.proj("session_id"), "video_id", rows["video_id"].dropna())
    of_video = rows["video_id"].map({int(r["video_id"]): int(r["session_id"]) for r in own}).astype("Int64")
    rows["session_id"] = rows.pop("of").astype("Int64").fillna(of_video)
    found = rows_inside(_visits() & restriction, "session_id", rows["session_id"].dropna())
    named = pd.DataFrame(found, columns=["session_id", "subject", "session_label"]).astype({"session_id": "Int64"})
    rows = rows.merge(named, how="left" if everything else "inner", on="session_id")
    rows = rows.sort_values(f"{prefix}_id", ascending=False, ignore_index=True).head(most or len(rows))
    rows.columns = [name.removeprefix(f"{prefix}_") for name in rows.columns]
    first = ["id", "at", "by", "what", "subject", "session_label", "session_id", "video_id"]
    return rows[[*first, *(c for c in rows.columns if c not in first)]]


def _people() -> Any:
    return lab.Subject.proj("population", "project")


def _visits() -> Any:
    return session.Session.proj("subject", "session_label", "session_date") * _people()


def _videos() -> Any:
    return video.Video.proj("session_id", "video_name", "activity", "camera_motion", "video_created") * _visits()


def _first(query: Any, most: int | None, *order: str) -> Any:
    """The first rows of a query by these columns, `most` of them (None: all)."""
    return frame_of(query & dj.Top(most, order)).sort_values(list(order), ignore_index=True, na_position="first")


def _counted(rows: Any, key: str, *counts: tuple[Any, dict[str, str]]) -> Any:
    """Rows with columns that are calculated from all rows of another query with the same `key`; 0 where there is none.
    Of few rows, the others are not read."""
    for query, columns in counts:
        own = query & inside(key, rows[key]) if len(rows) <= PART else query
        rows = rows.merge(frame_of(dj.U(key).aggr(own, **columns)), how="left", on=key)
        for name in columns.keys() - {"first", "last"}:
            rows[name] = rows[name].fillna(0).astype(int)
    return rows
