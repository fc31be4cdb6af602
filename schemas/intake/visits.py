"""People and their sessions: registered where they are new, changed where something else is stated of them."""

from __future__ import annotations

from collections.abc import Iterable

from .. import fit, kinetics, lab, session
from ..rows import counted, delete_below, inside, number, utc_now
from ..subject_codes import day_of
from ..transactions import next_id
from .records import VisitRecord


def session_ids(visits: Iterable[VisitRecord]) -> dict[tuple[str, str], int]:
    """Return the number of the session of each visit, by subject and label; people and sessions are registered where
    they are new, and population, height, mass and date are changed where they are stated. Call it in a transaction.
    """
    visits = list(dict.fromkeys(visits))
    add_people(visits)
    keys = list(dict.fromkeys((v.subject, v.session_label) for v in visits))
    rows = (session.Session & inside("subject", {v.subject for v in visits})).to_dicts()
    stored = {(r["subject"], r["session_label"]): r for r in rows}
    missing = [key for key in keys if key not in stored]
    numbers = {key: int(r["session_id"]) for key, r in stored.items()}
    if missing:
        first = next_id(session.Session, "session_id", len(missing))
        numbers |= {key: first + i for i, key in enumerate(missing)}
    dates = {(v.subject, v.session_label): v.date for v in visits if v.date is not None}
    session.Session.insert(
        {
            "session_id": numbers[key],
            "subject": key[0],
            "session_label": key[1],
            "session_date": dates.get(key) or day_of(key[1]),
            "session_created": utc_now(),
        }
        for key in missing
    )
    for key, date in dates.items():
        if key in stored and stored[key]["session_date"] != date:
            session.Session.update1({"session_id": numbers[key], "session_date": date})
    masses = {(v.subject, v.session_label): v.mass_kg for v in visits if v.mass_kg is not None}
    for key, mass_kg in masses.items():
        set_mass(numbers[key], mass_kg)
    return {key: numbers[key] for key in keys}


def add_people(visits: Iterable[VisitRecord]) -> None:
    """Register the people of visits with their projects; change population and height where they are stated."""
    visits = list(visits)
    codes = list(dict.fromkeys(v.subject for v in visits))
    projects = {v.subject: v.project for v in reversed(visits) if v.project}
    lab.Project.insert(({"project": p} for p in {*projects.values()}), skip_duplicates=True)
    known = set((lab.Subject & inside("subject", codes)).to_arrays("subject"))
    about = {"population": "unknown", "subject_created": utc_now()}
    new = ({"subject": code, "project": projects.get(code), **about} for code in codes if code not in known)
    lab.Subject.insert(new, skip_duplicates=True)
    for v in visits:
        set_population(v.subject, v.population)
        set_height(v.subject, v.height_m)


def set_population(subject: str, population: str | None) -> list[str]:
    """Put a registered person into a population (None: as it is); returns what changed, in words."""
    key = {"subject": subject}
    if not population or (lab.Subject & key).fetch1("population") == population:
        return []
    lab.Population.insert1({"population": population, "population_description": ""}, skip_duplicates=True)
    lab.Subject.update1({**key, "population": population})
    return [f"population of {subject} is {population} now"]


def set_height(subject: str, height_m: float | None) -> list[str]:
    """State the body height (m) of a registered person (None: as it is); returns what changed, in words.

    Fits of videos of one camera that were told another height are deleted with what was computed from them, so that the
    next populate computes them anew. Call it inside a transaction.
    """
    return [] if height_m is None else replace_height(subject, height_m)


def replace_height(subject: str, height_m: float | None) -> list[str]:
    """As `set_height`; None removes the height."""
    key = {"subject": subject}
    if number((lab.Subject & key).fetch1("subject_height")) == height_m:
        return []
    lab.Subject.update1({**key, "subject_height": height_m})
    changes = [f"height of {subject} is {'not known' if height_m is None else f'{height_m:g} m'} now"]
    sets = fit.FitSet & {"fit_set_kind": fit.SINGLE} & (session.Session & key).proj()
    if rows := counted(delete_below(fit.SessionFit, (fit.SessionFit & sets.proj()).keys())):
        changes.append(f"what was fitted without it was deleted: {rows}")
    return changes


def set_mass(session_id: int, mass_kg: float | None) -> list[str]:
    """State the body mass (kg) of the person at a visit (None: as it is); returns what changed, in words.

    Forces that were told another mass are deleted, so that the next populate computes them anew. Call it inside a
    transaction.
    """
    return [] if mass_kg is None else replace_mass(session_id, mass_kg)


def replace_mass(session_id: int, mass_kg: float | None) -> list[str]:
    """As `set_mass`; None removes the mass."""
    key = {"session_id": session_id}
    session.lock(session_id)  # who inserts forces waits here, then reads this mass
    stored = (session.BodyMass & key).to_arrays("body_mass")
    if (number(stored[0]) if len(stored) else None) == mass_kg:
        return []
    (session.BodyMass & key).delete_quick()
    if mass_kg is not None:
        session.BodyMass.insert1({**key, "body_mass": mass_kg})
    known = "not known" if mass_kg is None else f"{mass_kg:g} kg"
    return [f"body mass of the visit is {known} now", *delete_forces([session_id])]


def delete_forces(sessions: Iterable[int]) -> list[str]:
    """Delete the forces of visits whose mass or walking aid changed; returns how many, in words."""
    of_visits = kinetics.Kinetics & inside("session_id", sessions)
    rows = counted(delete_below(kinetics.Kinetics, of_visits.keys()))
    return [f"forces computed without it were deleted: {rows}"] if rows else []
