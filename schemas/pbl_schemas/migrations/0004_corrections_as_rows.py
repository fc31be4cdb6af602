"""Corrections of events as rows of EventCorrection, no longer methods; the trials that a visit's measures pool.

Until now a correction made a second chain of results beside that of the detected events, by a method `by-hand-vN`. Its
results now are those of the method whose events were corrected, instead of the ones from uncorrected events. A row is
copied to its new key before it is deleted, so that a run that was broken off can go on.
"""

# Every name is DataJoint's own or the server's, quoted by its adapter.
# ruff: noqa: S608

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from pbl_schemas import connection
from pbl_schemas.operations.catalog import quote

#: Tables by full name -> those that refer to them, each with pairs of its column and the one it refers to.
Children = Mapping[str, list[tuple[str, list[tuple[str, str]]]]]
#: Columns that rows of trials and rows of visits have in common with those that they are copied for.
_OF_TRIAL, _OF_VISIT = ("fit_set", "fit_method", "video_id"), ("fit_set", "fit_method")


def statements(conn: Any) -> list[str]:
    """New columns, then corrections and their results under other keys, then the trials of each visit."""
    cycles, visits, corrections = _gait("__gait_cycle"), _gdi("__session_gdi"), _gait("event_correction")
    out = []
    if "correction_no" not in _columns(conn, cycles):
        out.append(f"ALTER TABLE {cycles} ADD COLUMN correction_no SMALLINT NULL AFTER session_id")
    if not any(child == cycles for child, _ in _children(conn).get(corrections, ())):
        key = "(video_id, gait_method, correction_no)"
        out.append(
            f"ALTER TABLE {cycles} ADD FOREIGN KEY {key} REFERENCES {corrections} {key}"
            " ON UPDATE CASCADE ON DELETE RESTRICT"
        )
    if "session_corrected" not in _columns(conn, visits):
        comment = ":int16:trials of the set whose events a person corrected"
        column = f"session_corrected SMALLINT NOT NULL COMMENT '{comment}'"
        out.append(f"ALTER TABLE {visits} ADD COLUMN {column} AFTER session_cycles")
    if _columns(conn, _gait("hand_events")):
        out += _corrections(conn)
    if not _columns(conn, _gdi("__session_gdi__trial")) or _lacks_trials(conn):
        out += _trials(conn)
    return out


def changed(conn: Any) -> list[tuple[str, str]]:
    """Set and gait_method of the results that will be of corrected events, or are computed again."""
    out: list[tuple[str, str]] = []
    if _columns(conn, hand := _gait("hand_events")):
        members = quote(connection.schema_name("fit"), "fit_set__video")
        keypoints = quote(connection.schema_name("keypoints"), "__keypoints")
        corrected = conn.query(
            f"SELECT DISTINCT g.fit_set, g.gait_method FROM {hand} AS h JOIN {members} AS v USING (video_id)"
            f" JOIN {_gdi('__session_gdi')} AS g ON g.fit_set = v.fit_set AND g.gait_method = h.hand_from"
            f" LEFT JOIN {keypoints} AS k ON k.video_id = v.video_id AND k.tracking_method = v.tracking_method"
            " AND k.keypoint_method = v.keypoint_method"
            " WHERE v.tracking_method <=> h.hand_tracking AND k.keypoints_person_id <=> h.hand_person"
        )
        out += corrected.fetchall()
    if _columns(conn, visits := _gdi("__session_gdi")):
        out += conn.query(f"SELECT fit_set, gait_method FROM {visits} AS t0 WHERE {_missing()}").fetchall()
    return out


def _corrections(conn: Any) -> list[str]:
    """Rows of EventCorrection, the results by hand as those of the corrected method, and the end of what was before."""
    cycles, visits, corrections = _gait("__gait_cycle"), _gdi("__session_gdi"), _gait("event_correction")
    hand, methods = _gait("hand_events"), _gait("#gait_event_method")
    members = quote(connection.schema_name("fit"), "fit_set__video")
    keypoints = quote(connection.schema_name("keypoints"), "__keypoints")
    events = _gait("hand_events__event")
    out = [
        f"INSERT IGNORE INTO {corrections} (video_id, gait_method, correction_no, correction_withdrawn,"
        " correction_changed, correction_tracking, correction_person, correction_by, correction_at)"
        " SELECT video_id, hand_from, 1, 0, hand_changed, hand_tracking, hand_person, hand_by, hand_at"
        f" FROM {hand}",
    ]
    if _columns(conn, events):  # dropped first: a run that was broken off between the two tables has copied its rows
        out.append(
            f"INSERT IGNORE INTO {_gait('event_correction__event')} (video_id, gait_method, correction_no,"
            " corrected_no, corrected_time, corrected_side, corrected_kind, corrected_probability)"
            " SELECT e.video_id, h.hand_from, 1, e.hand_no, e.hand_time, e.hand_side, e.hand_kind, e.hand_probability"
            f" FROM {events} AS e JOIN {hand} AS h USING (video_id)"
        )
    # Results by the method of a correction that counts in their set were computed from uncorrected events.
    counts = (
        f"EXISTS (SELECT 1 FROM {corrections} AS c JOIN {members} AS v ON v.video_id = c.video_id"
        f" LEFT JOIN {keypoints} AS k ON k.video_id = v.video_id AND k.tracking_method = v.tracking_method"
        " AND k.keypoint_method = v.keypoint_method WHERE v.fit_set = t0.fit_set AND c.gait_method = t0.gait_method"
        " AND v.tracking_method <=> c.correction_tracking AND k.keypoints_person_id <=> c.correction_person"
    )
    out += _delete(conn, visits, f"t0.session_corrected = 0 AND {counts})")
    out += _delete(conn, cycles, f"t0.correction_no IS NULL AND {counts} AND c.video_id = t0.video_id)")
    by_hand = conn.query(f"SELECT gait_method, gait_params FROM {methods} WHERE gait_method_name = 'by-hand'")
    for old, params in by_hand.fetchall():
        new = str(json.loads(params)["automatic"])
        corrected = (
            f"EXISTS (SELECT 1 FROM {_gait('__gait_events')} AS g WHERE {_same('g', _OF_TRIAL)}"
            " AND g.gait_method = t.gait_method AND g.events_detector = 'by-hand')"
        )
        out += _copy(conn, cycles, _OF_TRIAL, (old, new), corrected, {"correction_no": "1"})
        pooled = (
            f"(SELECT COUNT(*) FROM {cycles} AS g WHERE {_same('g', _OF_VISIT)} AND g.gait_method = '{new}'"
            " AND g.correction_no IS NOT NULL)"
        )
        out += _copy(conn, visits, _OF_VISIT, (old, new), f"{pooled} > 0", {"session_corrected": pooled})
        slices = quote(connection.schema_name("study"), "study_slice")
        out.append(f"UPDATE {slices} SET gait_method = '{new}' WHERE gait_method = '{old}'")
        # Its checks were accepted under the old name.
        out.append(
            f"UPDATE {quote(connection.schema_name('review'), 'decision')} SET decision_about ="
            f" JSON_SET(decision_about, '$.gait_method', '{new}') WHERE decision_what = 'check'"
            f" AND JSON_VALUE(decision_about, '$.gait_method') = '{old}'"
        )
    out += _delete(conn, methods, "t0.gait_method_name = 'by-hand'")
    return [*out, f"DROP TABLE IF EXISTS {events}", f"DROP TABLE {hand}"]


def _lacks_trials(conn: Any) -> bool:
    """Whether a visit has no row of SessionGdi.Trial."""
    key = "fit_set, fit_method, gait_method, gdi_method, norm"
    trials = f"{_gdi('__session_gdi__trial')} AS p USING ({key})"
    rows = conn.query(f"SELECT 1 FROM {_gdi('__session_gdi')} AS s LEFT JOIN {trials} WHERE p.video_id IS NULL LIMIT 1")
    return rows.fetchone() is not None


def _trials(conn: Any) -> list[str]:
    """Rows of SessionGdi.Trial; a visit of which a trial is still to be computed is pending as well."""
    key = "fit_set, fit_method, gait_method, gdi_method, norm"
    return [
        *_delete(conn, _gdi("__session_gdi"), _missing()),
        f"INSERT IGNORE INTO {_gdi('__session_gdi__trial')} ({key}, video_id)"
        f" SELECT {key}, d.video_id FROM {_gdi('__session_gdi')} AS s JOIN {_measured()} USING ({key})",
    ]


def _measured() -> str:
    of_trial = "fit_set, fit_method, video_id, gait_method"
    return f"{_gdi('__g_d_i')} AS d JOIN {_gait('__spatiotemporal')} USING ({of_trial})"


def _missing() -> str:
    """Condition: a trial of a visit (`t0`) is not computed."""
    trials = quote(connection.schema_name("fit"), "__session_fit__trial")
    return (
        f"EXISTS (SELECT 1 FROM {trials} AS f WHERE f.fit_set = t0.fit_set AND f.fit_method = t0.fit_method AND NOT"
        f" EXISTS (SELECT 1 FROM {_measured()} WHERE d.fit_set = t0.fit_set AND d.fit_method = t0.fit_method"
        " AND d.gait_method = t0.gait_method AND d.gdi_method = t0.gdi_method AND d.norm = t0.norm"
        " AND d.video_id = f.video_id))"
    )


def _delete(conn: Any, table: str, where: str) -> list[str]:
    """Statements that delete the rows of a table (`t0` in the condition), and before them what refers to them."""
    # The full name instead: the server would look for an alias in the schema that is in use, and there is none.
    children, condition = _children(conn), where.replace("t0.", f"{table}.")

    def walk(path: str, target: str) -> Iterator[str]:
        for child, pairs in children.get(target, ()):
            on = " AND ".join(f"{child}.`{own}` = {target}.`{above}`" for own, above in pairs)
            yield from walk(f"{path} JOIN {child} ON {on}", child)
        yield f"DELETE {target} FROM {path} WHERE {condition}"

    return list(walk(table, table))


def _copy(
    conn: Any, table: str, of: tuple[str, ...], method: tuple[str, str], where: str, values: Mapping[str, str]
) -> list[str]:
    """Statements that copy rows (`t`) of a table and of all below it from one gait_method to another.

    Parameters
    ----------
    of
        Columns by which `where` knows a row; tables below without them are left alone.
    values
        Column -> SQL of its new value.
    """
    children, out, order = _children(conn), [], [table]
    for name in order:  # grows: a table comes again after the last one that it refers to
        order += [child for child, _ in children.get(name, ())]
    for name in sorted(set(order), key=lambda n: len(order) - order[::-1].index(n)):
        columns = _columns(conn, name)
        if not {*of, "gait_method"} <= set(columns):
            continue
        # The new columns are among those of the table only where an earlier run was broken off.
        new = {**{c: f"t.`{c}`" for c in columns}, "gait_method": f"'{method[1]}'", **(values if name == table else {})}
        listed, selected = ", ".join(f"`{c}`" for c in new), ", ".join(new.values())
        out.append(
            f"INSERT IGNORE INTO {name} ({listed}) SELECT {selected} FROM {name} AS t"
            f" WHERE t.gait_method = '{method[0]}' AND {where}"
        )
    return out


def _same(alias: str, columns: tuple[str, ...]) -> str:
    return " AND ".join(f"{alias}.{c} = t.{c}" for c in columns)


def _children(conn: Any) -> Children:
    found: dict[tuple[str, str, str], list[tuple[str, str]]] = {}
    rows = conn.query(
        "SELECT table_schema, table_name, constraint_name, referenced_table_schema, referenced_table_name, column_name,"
        " referenced_column_name FROM information_schema.key_column_usage WHERE referenced_table_name IS NOT NULL"
        " ORDER BY table_schema, table_name, constraint_name, ordinal_position"
    )
    for schema, table, constraint, above_schema, above, own, target in rows.fetchall():
        key = (quote(above_schema, above), quote(schema, table), constraint)
        found.setdefault(key, []).append((own, target))
    out: dict[str, list[tuple[str, list[tuple[str, str]]]]] = {}
    for (above, child, _), pairs in found.items():
        out.setdefault(above, []).append((child, pairs))
    return out


def _columns(conn: Any, table: str) -> list[str]:
    """Columns of a table by its quoted name, in their order; none where it does not exist."""
    schema, name = table.strip("`").split("`.`")
    rows = conn.query(
        "SELECT column_name FROM information_schema.columns WHERE table_schema = %s AND table_name = %s"
        " AND extra NOT LIKE '%%GENERATED%%' ORDER BY ordinal_position",
        args=(schema, name),
    )
    return [str(row[0]) for row in rows.fetchall()]


def _gait(table: str) -> str:
    return quote(connection.schema_name("gait"), table)


def _gdi(table: str) -> str:
    return quote(connection.schema_name("gdi"), table)
