"""Records of intake: recordings and their visits, their files, and the outcome."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.names import check_height, check_label, check_mass, is_plain, normalised_label
from pbl_pipeline.records import number
from pbl_pipeline.texts import code_of

from .. import fit, gait, gdi, kinetics, lab, linking, session, video
from ..rows import counted, delete_below, insert_in_parts, inside, rows_inside, utc_now
from ..session import UNLABELLED
from ..subject_codes import check_subject, day_of
from ..transactions import next_id

#: Return a `PblError` USAGE about a registration.
usage = functools.partial(PblError, "USAGE", next_step="see `pbl ingest --help`")


def set_condition(video_id: int, activity: str | None = None, pace: str | None = None) -> list[str]:
    """State activity or pace of a registered video (None: as it is), of one of several cameras for all of the trial's;
    returns what changed, in words.

    Where a session's measures pool the video now and did not before, or the other way round, they are deleted, so that
    the next populate recomputes them; likewise the measures of a video that is or was one of a task. Call it inside
    a transaction.

    Raises `PblError` DB_NOT_FOUND for an unknown number; USAGE for labels of more than 32 characters.
    """
    videos = fit.videos_of(fit.trial_of(video_id))
    return list(dict.fromkeys(change for v in videos for change in _set_condition(v, activity, pace)))


def _set_condition(video_id: int, activity: str | None, pace: str | None) -> list[str]:
    from pbl_pipeline.gait import TASK_MEASURES, Condition

    key = {"video_id": video_id}
    before = video.conditions(key).get(video_id)
    if before is None:
        raise video.unknown_video(video_id)
    changes = []
    after = Condition(before.activity if activity is None else activity, before.pace if pace is None else pace)
    if activity is not None and after.activity != before.activity:
        video.Video.update1({**key, "activity": activity})
        changes.append(f"activity is {activity} now")
    if after.pace != before.pace:
        video.Pace.insert1({**key, "pace": after.pace}, replace=True)
        changes.append(f"pace is {after.pace} now")
    of_task = after.activity != before.activity and not {before.activity, after.activity}.isdisjoint(TASK_MEASURES)
    made = (gait.Spatiotemporal & key).keys() if of_task else []
    if rows := counted(delete_below(gait.Spatiotemporal, made)):
        changes.append(f"measures of the task were deleted: {rows}")
    if after.pool != before.pool:
        sets = fit.FitSet & (fit.FitSet.Video & key).proj()
        if rows := counted(delete_below(gdi.SessionGdi, (gdi.SessionGdi & sets).keys())):
            changes.append(f"what pooled it was deleted: {rows}")
    return changes


@dataclasses.dataclass(frozen=True)
class Methods:
    """Names of the methods that a recording goes through; None takes the default of the library."""

    tracking: str | None = None
    subject: str | None = None
    keypoint: str | None = None
    fit: str | None = None
    gait: str | None = None
    gdi: str | None = None
    norm: str | None = None
    kinetics: str | None = None


@dataclasses.dataclass(frozen=True)
class VisitRecord:
    """Statements about a recording and its visit. None leaves a column of subject or visit unchanged."""

    subject: str
    session_label: str = UNLABELLED
    project: str | None = None  # of a subject that is new
    camera_file: str | Path | None = None
    camera_motion: str | None = None  # None: handheld with the phone's log, static without
    activity: str | None = None  # None: walking
    person: int | None = None  # of the tracking; None: chosen automatically
    population: str | None = None
    pace: str | None = None  # None: unknown
    height_m: float | None = None
    date: datetime.date | None = None  # None: the day that the label names
    mass_kg: float | None = None  # of the person at the visit

    def __post_init__(self) -> None:
        """Normalise the labels and codes, so that all ways into the tables agree."""
        for name in ("subject", "session_label", "project", "activity", "pace", "population"):
            if isinstance(text := getattr(self, name), str):
                object.__setattr__(self, name, code_of(name, normalised_label(text)))

    def check(self, key: object = None) -> None:
        """Raise `PblError` USAGE for a code that could be a name or a label too long; FIT_INPUT for height or mass."""
        check_subject(self.subject, "pass such a code with --subject", key)
        for what, text, longest in (
            ("visit", self.session_label, 64),
            ("project", self.project, 32),
            ("activity", self.activity, 32),
            ("pace", self.pace, 32),
            ("population", self.population, 32),
        ):
            check_label(what, text or "", longest, least=int(what == "visit"))
        check_height(self.height_m)
        check_mass(self.mass_kg)

    def text(self) -> str:
        """Return subject and session in words."""
        return f"subject {self.subject}, session {self.session_label}"


@dataclasses.dataclass(frozen=True)
class Registered:
    """The outcome for one file."""

    path: Path
    status: str  # registered, known (nothing changed), moved (path updated), updated (something was added), refused
    video_id: int | None = None
    note: str = ""  # the status in words
    error: PblError | None = None


@dataclasses.dataclass(frozen=True)
class File:
    """A file with the SHA-256 of its bytes and its length (bytes); camera: the row of its calibration."""

    path: Path
    sha256: str
    size: int
    camera: Mapping[str, Any] | None = None

    @classmethod
    def of(cls, path: Path, sha256: str = "") -> File:
        """Read the bytes of a file, unless their `sha256` is known. Raises `PblError` VIDEO_MISSING, VIDEO_EMPTY; USAGE
        for a path that no row can hold."""
        from pbl_pipeline.video import check_file

        if not os.path.isfile(path):  # not Path.is_file: that raises where a folder on the way may not be entered
            raise _no_video("VIDEO_MISSING", "it is not a file" if os.path.exists(path) else "no such file", path)
        check_path(path)
        if not path.stat().st_size:
            raise _no_video("VIDEO_EMPTY", "0 bytes", path)
        return cls(path, sha256 or sha256_of(check_file(path)), path.stat().st_size)


class Recording:
    """A recording that is to be registered: `OneCamera`, `SeveralCameras` or `LaboratoryMarkers`.

    `register` calls the methods in the order in which they stand here. One that does not apply to a kind does nothing.
    """

    visit: VisitRecord
    files: tuple[File, ...] = ()  # what `read` read
    sensors: Any = None  # `Sensors` of videos
    markers: ClassVar[bool] = False  # whether it goes straight to the fit, without tracking and keypoints

    @property
    def paths(self) -> tuple[Path, ...]:
        """Its files, absolute."""
        raise NotImplementedError

    @property
    def motion(self) -> str:
        """Value of camera_motion in Video."""
        raise NotImplementedError

    def check(self, methods: Methods) -> None:
        """Raise what `VisitRecord.check` raises; `PblError` USAGE for what does not apply to this kind of recording."""
        self.visit.check()

    def read(self) -> None:
        """Read its files, without any tables. Raises `PblError`, or `RefusedFile` if one of them, and so all of them,
        cannot be registered."""
        raise NotImplementedError

    def check_known(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Raise `PblError` USAGE where its files are registered (`rows` of Video) as something else."""

    def update(self, row: Mapping[str, Any]) -> list[str]:
        """Add to a registered file (its row of Video) what is new of its kind; returns the changes in words."""
        return []

    def complete(self, chosen: Mapping[str, str]) -> None:
        """Read what only a new recording needs; `chosen`: keys of its methods. Raises `PblError`."""

    def check_session(self, session_id: int) -> None:
        """Raise `PblError` USAGE where it cannot be fitted together with what the session has."""

    def insert(self, numbers: Sequence[int]) -> list[str]:
        """Insert its rows beside those of Video, in a transaction; returns a note on each file."""
        return [""] * len(numbers)


class RefusedFile(Exception):
    """One of the files of a recording cannot be registered, and the others with it."""

    def __init__(self, path: Path, error: PblError) -> None:
        super().__init__(str(error))
        self.path, self.error = path, error

    def error_of(self, path: Path) -> PblError:
        """Return the error to report of a file of the recording."""
        if path == self.path:
            return self.error
        return usage(
            f"{path.name} with {self.path.name}, which is refused ({self.error.code})",
            "all videos of the trial",
            next_step="correct that one, then register the trial again",
            key=path,
        )


def check_path(path: Path) -> None:
    """Raise `PblError` USAGE for a path that cannot be kept in a row."""
    if not is_plain(str(path)):
        raise usage(
            "a path with line breaks, other control characters, or bytes that are not UTF-8",
            "a path of ordinary characters",
            next_step="rename the file or folder",
            key=ascii(str(path)),
        )
    if len(str(path)) > 1000:
        found = f"a path of {len(str(path))} characters"
        raise usage(found, "at most 1000", next_step="move the file to a shorter path", key=path)


def _no_video(code: str, found: str, path: Path) -> PblError:
    next_step = "check the path" if code == "VIDEO_MISSING" else "copy it from the phone again"
    return PblError(code, found=found, expected="a video file", next_step=next_step, key=path)


def session_ids(visits: Iterable[VisitRecord]) -> dict[tuple[str, str], int]:
    """Return the number of the session of each visit, by subject and label; people and sessions are registered where
    they are new, and population, height, mass and date are changed where they are stated. Call it in a transaction.
    Raises what `linking.link_people` raises.
    """
    visits = list(dict.fromkeys(visits))
    add_people(visits)
    keys = list(dict.fromkeys((v.subject, v.session_label) for v in visits))
    rows = rows_inside(session.Session(), "subject", (v.subject for v in visits))
    stored = session.by_label(rows)
    missing = [key for key in keys if key not in stored]
    numbers = {key: int(r["session_id"]) for key, r in stored.items()}
    if missing:
        first = next_id(session.Session, "session_id", len(missing))
        numbers |= {key: first + i for i, key in enumerate(missing)}
    dates, now = {(v.subject, v.session_label): v.date for v in visits if v.date is not None}, utc_now()
    insert_in_parts(
        session.Session,
        (
            {
                "session_id": numbers[key],
                "subject": key[0],
                "session_label": key[1],
                "session_date": dates.get(key) or day_of(key[1]),
                "session_created": now,
            }
            for key in missing
        ),
    )
    linking.link_visits({key: numbers[key] for key in keys})
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
    insert_in_parts(lab.Project, ({"project": p} for p in {*projects.values()}), skip_duplicates=True)
    known = {r["subject"] for r in rows_inside(lab.Subject.proj(), "subject", codes)}
    about = {"population": "unknown", "subject_created": utc_now()}
    new = ({"subject": code, "project": projects.get(code), **about} for code in codes if code not in known)
    insert_in_parts(lab.Subject, new, skip_duplicates=True)
    linking.link_people(codes)
    for v in visits:
        set_population(v.subject, v.population)
        if v.height_m is not None:
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
    """State the body height (m) of a registered person, None to remove it; returns what changed, in words.

    Fits of videos of one camera that were told another height are deleted with their dependent results, so that the
    next populate recomputes them. Call it inside a transaction.
    """
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
    """State the body mass (kg) of the person at a visit, None to remove it; returns what changed, in words.

    Forces that were told another mass are deleted, so that the next populate recomputes them. Call it inside a
    transaction.
    """
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
