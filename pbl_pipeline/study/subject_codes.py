"""Other codes for the persons of a study."""

from __future__ import annotations

import dataclasses
import secrets
from typing import Any

import pandas as pd

from .frame_columns import FRAMES
from .types import StudyData


def deidentified(study: StudyData, prefix: str = "P") -> tuple[StudyData, pd.DataFrame]:
    """The study with new codes, and the key to them: `subject, visit, new_subject, new_visit`. Keep the key apart.

    Persons are numbered in random order, and each person's visits V1, V2, ... in order of their days, since a visit is
    often named by its date. Rows are put in order of the new codes. Columns of `visits` beyond those of `FRAMES` are
    left out. `reason` and the texts of the description stay: read them before the study leaves the house.
    """
    visits: Any = study.visits.sort_values(["subject", "days", "visit"])
    persons = list(dict.fromkeys(visits["subject"]))
    secrets.SystemRandom().shuffle(persons)
    width = max(3, len(str(len(persons))))
    codes = {old: f"{prefix}{i:0{width}d}" for i, old in enumerate(persons, 1)}
    key: Any = visits[["subject", "visit"]].assign(
        new_subject=visits["subject"].map(codes),
        new_visit=[f"V{n}" for n in visits.groupby("subject").cumcount() + 1],
    )

    def renamed(name: str, frame: Any) -> Any:
        columns = [c.name for c in FRAMES[name]]
        if "visit" not in columns:
            return frame
        new = frame[columns].merge(key, on=["subject", "visit"])
        new = new.assign(subject=new["new_subject"], visit=new["new_visit"])[columns]
        return new.sort_values(["subject", "visit"], kind="stable", ignore_index=True)

    changed = {name: renamed(name, getattr(study, name)) for name in FRAMES}
    return dataclasses.replace(study, **changed), key.sort_values(["new_subject", "new_visit"], ignore_index=True)
