"""Drawn visits: synthetic markers of three persons at two visits each, to look at pages before the first patient."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np

from pbl_pipeline.keypoints import WorldMarkers
from pbl_pipeline.synthetic import Impairment, SynthSpec, synthesise

#: Code of a person -> body height (m), mass (kg), and for each of `VISITS` what was put in and the clinical scores.
PERSONS = {
    "DRAWN1": (1.68, 66.0, (("stiff_knee:0.9", "11", "0.85"), ("stiff_knee:0.3", "14", "1.1"))),
    "DRAWN2": (1.81, 84.0, (("crouch:0.7", "12", "0.95"), ("crouch:0.5", "13", "1.0"))),
    "DRAWN3": (1.74, 71.0, (("short_steps:0.6", "15", "0.9"), ("short_steps:0.6", "15", "0.9"))),
}
VISITS = {"pre": datetime.date(2026, 1, 12), "3_months": datetime.date(2026, 4, 13)}
SECONDS, NOISE_M = 9.0, 0.002
PROJECT, COHORT = "drawn", "drawn"


def markers(seed: int, visit: int, impairment: str, speed: float) -> WorldMarkers:
    """Markers of a walk at a speed (m/s) of the person of a seed, with the noise of a visit."""
    spec = SynthSpec(
        seed=seed, impairments=(Impairment.parse(impairment),), view="sagittal", camera="panned", seconds=SECONDS,
        fps=50.0, speed_m_per_s=speed, noise="none",
    )  # fmt: skip
    made = synthesise(spec)
    truth, names = made.truth, made.keypoints.names
    points = truth.markers_world_m - [0.0, 0.0, 1.0] * truth.floor_height_m[:, None, None]
    points = points + np.random.default_rng([seed, visit]).normal(0.0, NOISE_M, points.shape)
    return WorldMarkers(truth.time_s, names, spec.marker_set, points, np.ones(points.shape[:2]))


def register_drawn(folder: Path) -> list[int]:
    """Write the markers to a folder and register them with scores and roles; return the numbers of the recordings.

    Safe to repeat. Raises `PblError` as `intake.register` and `import_sheets`.
    """
    from pbl_schemas.intake import LaboratoryMarkers, VisitRecord, register
    from pbl_schemas.studies.study_sheets import import_sheets

    recordings, rows = [], ["subject,visit,role,population,cohort,group,mJOA,10MWT_m_per_s"]
    folder.mkdir(parents=True, exist_ok=True)
    for seed, (subject, (height_m, mass_kg, visits)) in enumerate(PERSONS.items()):
        for visit, ((role, day), (impairment, mjoa, speed)) in enumerate(zip(VISITS.items(), visits, strict=True)):
            path = folder / f"{subject} {day}.npz"
            markers(seed, visit, impairment, float(speed)).save(path)
            stated = VisitRecord(subject, str(day), PROJECT, height_m=height_m, mass_kg=mass_kg, pace="self_selected")
            recordings.append(LaboratoryMarkers(path, stated))
            rows.append(f"{subject},{day},{role},patient,{COHORT},patients,{mjoa},{speed}")
    done = register(recordings)
    for one in done:
        if one.error is not None:
            raise one.error
    sheet = folder / "visits.csv"
    sheet.write_text("\n".join(rows) + "\n", encoding="utf-8")
    for error in import_sheets([sheet]).errors:
        raise error
    return [one.video_id or 0 for one in done]
