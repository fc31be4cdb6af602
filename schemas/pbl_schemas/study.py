"""Studies: roles of visits, clinical scores, cohorts, and slices that freeze the data of figures."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from pbl_pipeline.errors import PblError

from . import fit, gait, gdi, keypoints, lab, session, tracking  # noqa: F401  the definitions refer to them
from .datajoint_setup import dj

schema = dj.Schema()

#: Roles before the event of a study.
FIRST_ROLES = ("baseline", "pre")
_ROLE = re.compile(r"[a-z0-9][a-z0-9_]{0,31}")
_AFTER = re.compile(r"(\d{1,4})_(day|week|month|year)s?")
_DAYS = {"day": 1.0, "week": 7.0, "month": 30.4375, "year": 365.25}


def role_days(role: str) -> float | None:
    """Days after the event that a role names: 42 for "6_weeks", -inf for those before it; None for custom ones."""
    if role in FIRST_ROLES:
        return -math.inf
    match = _AFTER.fullmatch(role)
    return int(match[1]) * _DAYS[match[2]] if match else None


def is_role(text: str) -> bool:
    """Return whether a text can be a role: small letters, digits and underscores."""
    return _ROLE.fullmatch(text) is not None


@schema
class Visit(dj.Manual):
    definition = """
    # what a session is in a study
    -> session.Session
    ---
    visit_role             : varchar(32)       # baseline, pre, 6_weeks, 3_months, 6_months, or the study's own word
    visit_days=null        : int32             # (d) from the event of the study, negative before it
    visit_age=null         : float64           # (years) of the person at the visit; no birth date is kept
    intervention=''        : varchar(64)       # surgery, therapy, prosthesis, ...
    intervention_date=null : date              # its day
    assistive_device=''    : varchar(64)       # cane, walker, ... used in the recordings; none where there was none
    orthosis=''            : varchar(64)       # worn in the recordings; none where there was none
    visit_note=''          : varchar(1000)     # the examiner's; no names
    """


@schema
class ClinicalInstrument(dj.Lookup):
    definition = """
    # a clinical score: its range, direction and minimal important change; insert your own
    instrument            : varchar(32)        # short name
    ---
    instrument_name       : varchar(128)       # full name
    instrument_unit       : varchar(16)        # of its values
    instrument_low=null   : float64            # in the unit (see instrument_unit): a lower value is refused
    instrument_high=null  : float64            # in the unit (see instrument_unit): a higher value is refused
    instrument_source=''  : varchar(255)       # of the range: the scale's own, or bounds that only mistakes exceed
    higher_is_better      : bool               # direction
    ordinal               : bool               # ranks (Spearman) and no measure (Pearson)
    minimal_change=null   : float64            # in the unit (see instrument_unit): minimal important change, null where none is taken over
    minimal_change_source='' : varchar(255)    # who found it, in whom
    instrument_classes='' : varchar(255)       # classes by lowest value, such as: 0 high risk; 41 at risk; 51 low risk
    minimal_change_classes='' : varchar(255)   # minimal_change by lowest value before, such as: 0 3; 12 2; 15 1; empty: at all values
    """  # noqa: E501


@schema
class ClinicalScore(dj.Manual):
    definition = """
    # a clinical score of a visit; one outside the range of its instrument is refused
    -> session.Session
    -> ClinicalInstrument
    ---
    score_value : float64                      # in the unit (see ClinicalInstrument.instrument_unit)
    """

    def insert(self, rows: Any, *args: Any, **options: Any) -> None:
        """DataJoint's own, after every value was compared with the range of its instrument. Raises `PblError`
        SCORE_RANGE; then nothing is inserted. An instrument that is unknown is DataJoint's error."""
        rows = self._dicts(rows)
        check_scores(rows)
        super().insert(rows, *args, **options)

    def update1(self, row: Mapping[str, Any]) -> None:
        """DataJoint's own, after the value was compared with the range. Raises `PblError` SCORE_RANGE."""
        if "score_value" in row:
            check_scores([row])
        super().update1(row)

    def _dicts(self, rows: Any) -> list[dict[str, Any]]:
        """Rows of any kind that DataJoint takes (mappings, sequences, records, a frame, a query) as dicts."""
        if hasattr(rows, "to_dicts"):  # a query of DataJoint
            return (rows() if isinstance(rows, type) else rows).to_dicts()
        if hasattr(rows, "to_dict"):  # a frame of pandas
            plain = rows if rows.index.names == [None] else rows.reset_index()
            return plain.to_dict("records")
        names = list(self.heading.names)
        return [_as_dict(row, names) for row in rows]


def _as_dict(row: Any, names: list[str]) -> dict[str, Any]:
    if isinstance(row, Mapping):
        return dict(row)
    if fields := getattr(getattr(row, "dtype", None), "names", None):
        return {name: row[name] for name in fields}
    if isinstance(row, str) or len(row) != len(names):
        raise dj.DataJointError(f"a row of ClinicalScore is a mapping, or a sequence of {', '.join(names)}: {row!r}")
    return dict(zip(names, row, strict=True))


def check_scores(rows: Iterable[Mapping[str, Any]]) -> None:
    """Raise `PblError` SCORE_RANGE for the first row of ClinicalScore whose value its instrument cannot have."""
    rows = list(rows)
    asked = [{"instrument": str(row.get("instrument"))} for row in rows]
    names = {a["instrument"]: a for a in asked}.values()
    known = {r["instrument"]: r for r in (ClinicalInstrument & list(names)).to_dicts()} if names else {}
    for row in rows:
        if (instrument := known.get(str(row.get("instrument")))) is not None:
            check_score(row.get("score_value"), instrument, key=f"session_id={row.get('session_id')}")


def important_change(instrument: Mapping[str, Any], before: float) -> float | None:
    """Return the minimal important change of a score that was `before`, by the row of its instrument; None without."""
    from pbl_pipeline.study import minimal_change_at

    return minimal_change_at(before, instrument["minimal_change"], instrument["minimal_change_classes"])


def check_score(value: Any, instrument: Mapping[str, Any], key: object = None) -> None:
    """Raise `PblError` SCORE_RANGE for a value that a row of ClinicalInstrument does not allow: outside its range, or a
    fraction of an ordinal score in points."""
    low, high = (instrument[f"instrument_{k}"] for k in ("low", "high"))
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    whole = bool(instrument["ordinal"]) and instrument["instrument_unit"] == "points"
    inside = math.isfinite(number) and (low is None or number >= low) and (high is None or number <= high)
    if inside and (number.is_integer() or not whole):
        return
    kind = "a whole number" if whole else "a number"
    bounds = " and ".join(f"at {w} {b:g}" for w, b in (("least", low), ("most", high)) if b is not None)
    raise PblError(
        "SCORE_RANGE",
        found=f"{instrument['instrument']} of {f'{value:.10g}' if isinstance(value, float) else repr(value)}",
        expected=f"{kind}{' of ' if bounds else ''}{bounds} {instrument['instrument_unit']}".rstrip(),
        next_step="correct the score at its source; leave out one that was not taken",
        key=key,
    )


@schema
class Cohort(dj.Manual):
    definition = """
    # people of a study
    cohort           : varchar(32)             # short name
    ---
    cohort_title=''  : varchar(200)            # full title
    """


@schema
class CohortMember(dj.Manual):
    # No part of Cohort: forgetting one person must not take the cohort of all others away.
    definition = """
    # who is in a cohort, who is not, and why
    -> Cohort
    -> lab.Subject
    ---
    member_included   : bool                   # false: considered and left out
    member_group=''   : varchar(32)            # such as surgery or control; empty: the person's population
    member_reason=''  : varchar(255)           # to include or exclude
    """


@schema
class StudySlice(dj.Manual):
    definition = f"""
    # frozen: the visits and methods that figures and tables were made of
    study_slice          : varchar(32)         # short name
    ---
    slice_kind           : {fit.KIND_TYPE} # fit_set_kind of the recordings that count
    -> [nullable] Cohort
    -> [nullable] tracking.TrackingMethod
    -> [nullable] keypoints.KeypointMethod
    -> fit.FitMethod
    -> gait.GaitEventMethod
    -> gdi.GdiModel
    -> gdi.NormativeSet
    slice_roles          : json                # roles that count, [] for all
    slice_event=''       : varchar(64)         # what the days of the visits count from, such as surgery
    slice_note=''        : varchar(1000)       # shown on the report
    slice_n              : int32               # visits, also those that do not count
    slice_hash           : char(16)            # over the rows of all visits
    slice_code_version   : varchar(64)         # of the code that froze it
    slice_created        : datetime            # UTC
    """


@schema
class StudySliceVisit(dj.Manual):
    # No part of StudySlice, as CohortMember.
    definition = """
    # a visit of a slice, as it was when the slice was frozen
    -> StudySlice
    -> session.Session
    ---
    slice_included       : bool                # whether it counts
    slice_reason=''      : varchar(255)        # why not
    slice_fit_set=''     : char(16)            # set of videos that its measures are of, empty where there are none
    slice_visit_hash     : char(16)            # over its rows
    """
