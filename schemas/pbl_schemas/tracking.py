"""People in a video, and the one who is measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.files import check_numbers, load_npz
from pbl_pipeline.records import definition, to_row
from pbl_pipeline.results.people import SubjectChoice as Choice
from pbl_pipeline.results.people import TrackFigures
from pbl_pipeline.temporary import new_folder

from . import video
from .datajoint_setup import dj
from .method_rows import method_columns, method_row
from .origin import Origin, computes, origin_columns
from .record_parts import part_of
from .rows import delete_below, inside, one, utc_now
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import tracking as lib

schema = dj.Schema()

#: Statuses of a choice that let the chain go on.
CHOSEN = ("CHOSEN", "MANUAL")


@schema
class TrackingMethod(dj.Lookup):
    stage = "tracking"
    definition = f"""
    # frozen parameters of person detection, association and choice
    {method_columns("tracking")}
    """


@schema
class SubjectMethod(dj.Lookup):
    stage = "subject"
    definition = f"""
    # frozen parameters of the automatic choice of the measured person
    {method_columns("subject")}
    """


@schema
class TrackingSelection(dj.Manual):
    definition = """
    # which videos are tracked by which method
    -> video.Video
    -> TrackingMethod
    ---
    -> SubjectMethod
    """


@schema
class SubjectOverride(dj.Manual):
    definition = """
    # a person's decision who is measured; it wins over the automatic choice
    -> TrackingSelection
    ---
    override_person_id : int16                 # number of the person in the tracking
    override_created   : datetime              # when decided, UTC
    """


@schema
class Tracking(dj.Computed):
    definition = f"""
    # everybody in the video, numbered in order of appearance
    -> video.VideoInfo
    -> TrackingSelection
    ---
    n_persons       : int16
    detector        : varchar(64)              # name of the person detector
    tracks          : <object@arrays>         # npz: time_s (T) s, person_id (N), box_px (N,T,4) px, roi_px (N,T,4) px px px rad, score (N,T) 0..1, observed (N,T)
    {origin_columns("tracking")}
    """  # noqa: E501

    Person = part_of("Person", TrackFigures, comment="one person's track in figures")

    @property
    def key_source(self) -> Any:
        """Files that could be probed: one that is not a video has a single error row, in VideoInfo."""
        return TrackingSelection.proj() * video.VideoInfo.proj() - video.NotUsable

    def make_fetch(self, key: dict) -> tuple:
        method = method_row(TrackingMethod, key)
        probed = one(video.Video * video.VideoInfo & key)
        return probed, file_ref(probed.pop("frame_time")), method

    @computes
    def make_compute(
        self, key: dict, probed: Mapping[str, Any], times: dict, method: Mapping[str, Any]
    ) -> tuple[lib.Tracking, str]:
        from pbl_pipeline.tracking import track_people

        path = video.registered_file(probed["video_path"], probed["video_sha256"], key)
        tracker = methods.stored(**method)
        with stored_file(times) as stored:
            info = video.info_of_row(probed, np.load(stored, allow_pickle=False))
        return track_people(path, params=tracker, info=info), tracker.hash

    def make_insert(self, key: dict, tracking: lib.Tracking, sha: str, origin: Origin) -> None:
        with new_folder() as folder:
            save_tracking(tracking, folder / "tracks.npz")
            row = {"n_persons": len(tracking.persons), "detector": tracking.detector, "tracks": folder / "tracks.npz"}
            of_model = origin.row("tracking", method_hash=sha, model_sha256=tracking.model_sha256)
            self.insert1({**key, **row, **of_model})
        self.Person.insert_records(key, (p.figures(tracking.time_s) for p in tracking.persons))


@schema
class SubjectChoice(dj.Computed):
    definition = f"""
    # who is measured: chosen by score with a written reason, or by a person (SubjectOverride)
    -> Tracking
    ---
    {definition(Choice)}
    contact_sheet=null   : <object@arrays>    # JPEG of the people, boxed and numbered, where somebody has to choose
    {origin_columns("choice")}
    index (choice_status)
    """

    def make_fetch(self, key: dict) -> tuple:
        file = one(video.Video & key, "video_path", "video_sha256")
        tracks, detector, model = one(Tracking & key, "tracks", "detector", "tracking_model_sha256")
        size = one(video.VideoInfo & key, "width", "height")
        override = (SubjectOverride & key).to_dicts()
        person = int(override[0]["override_person_id"]) if override else None
        method = method_row(SubjectMethod, one(TrackingSelection & key))
        elsewhere = None if override else _decided_elsewhere(key)
        return file, file_ref(tracks), (int(size[0]), int(size[1])), (detector, model), person, elsewhere, method

    @property
    def key_source(self) -> Any:
        return Tracking - video.NotUsable

    @computes
    def make_compute(
        self,
        key: dict,
        file: tuple,
        ref: dict,
        size: tuple,
        about: tuple,
        override: int | None,
        elsewhere: tuple | None,
        method: Mapping[str, Any],
    ) -> tuple[Choice, bytes | None, str]:
        from pbl_pipeline.tracking import carried_choice, choose_subject, contact_sheet_jpeg

        chooser = methods.stored(**method)
        with stored_file(ref) as path:
            tracking = load_tracking(path, size, *about)
        if elsewhere is None:
            choice = choose_subject(tracking, params=chooser, override=override)
        else:
            other_tracks, other_about, number_there, other_method = elsewhere
            with stored_file(other_tracks) as path:
                other = load_tracking(path, size, *other_about)
            choice = carried_choice(other, number_there, other_method, tracking, chooser)
        sheet = None
        if choice.status == "NEEDS_CHOICE":
            path = video.registered_file(file[0], file[1], key)
            sheet = contact_sheet_jpeg(path, tracking, choice)
        return choice, sheet, chooser.hash

    def make_insert(self, key: dict, choice: Choice, sheet: bytes | None, sha: str, origin: Origin) -> None:
        with new_folder() as folder:
            picture = folder / "persons.jpg"
            if sheet is not None:
                picture.write_bytes(sheet)
            row = {**to_row(choice), "contact_sheet": None if sheet is None else picture}
            self.insert1({**key, **row, **origin.row("choice", method_hash=sha)})


def chosen() -> Any:
    """Rows of `SubjectChoice` that name a person."""
    return SubjectChoice & [{"choice_status": s} for s in CHOSEN]


def _decided_elsewhere(key: Mapping[str, Any]) -> tuple | None:
    """Return the last decision about another tracking of this video: its tracks, detector and model, the person's
    number there, the method; None without one."""
    others = Tracking * SubjectOverride & {"video_id": key["video_id"]}
    others &= f"tracking_method != '{key['tracking_method']}'"
    for row in others.to_dicts(order_by=["override_created DESC", "tracking_method"]):
        there = {k: row[k] for k in Tracking.primary_key}
        number_there = int(row["override_person_id"])
        if Tracking.Person & there & {"person_id": number_there}:
            about = (row["detector"], row["tracking_model_sha256"])
            return file_ref(row["tracks"]), about, number_there, row["tracking_method"]
    return None


# ---------------------------------------------------------------------------------------------- override and effects
def set_override(key: Mapping[str, Any], person_id: int) -> None:
    """Write a person's decision for one tracking selection. `drop_outdated_choices` then removes results that
    contradict it. Raises `PblError` SUBJECT_UNKNOWN_PERSON when the video is tracked and has no such person."""
    key = {"video_id": key["video_id"], "tracking_method": key["tracking_method"]}
    if Tracking & key:
        persons = sorted(int(p) for p in (Tracking.Person & key).to_arrays("person_id"))
        if person_id not in persons:
            raise PblError(
                "SUBJECT_UNKNOWN_PERSON",
                found=said("person {n}", n=person_id),
                expected=f"one of {persons}" if persons else "a video in which a person was found",
                next_step="choose one of the numbers above",
                key=f"video_id={key['video_id']}",
            )
    row = {**key, "override_person_id": person_id, "override_created": utc_now()}
    if SubjectOverride & key:
        SubjectOverride.update1(row)
    else:
        SubjectOverride.insert1(row)


def with_several_methods(videos: Collection[int]) -> set[int]:
    """Return those of these videos that are tracked by several methods, each of which numbers people anew."""
    if not videos:
        return set()
    planned = (TrackingSelection & inside("video_id", videos)).to_arrays("video_id").tolist()
    return {v for v in planned if planned.count(v) > 1}


def choose_command(key: Mapping[str, Any], persons: str, several: Collection[int] | None = None) -> str:
    """Return the command that decides about the tracking `key`; `persons`: such as "1|2". several:
    `with_several_methods` of videos that the key's is among; asked for where it is not given."""
    number = int(key["video_id"])
    named = number in (with_several_methods([number]) if several is None else several)
    return f"pbl choose {number} {persons}" + (f" --tracking-method {key['tracking_method']}" if named else "")


def drop_outdated_choices(restriction: Any = True) -> dict[str, int]:
    """Delete choices that contradict the overrides (another person was chosen, or the override was withdrawn), and all
    dependent results, in one transaction.

    An override that confirms the automatic choice changes nothing that was computed: the choice becomes MANUAL and
    stays.

    Returns the number of deleted rows by table, empty if nothing was outdated. The next populate recomputes them.
    """
    decided = SubjectChoice.proj("choice_status", "chosen_person_id") * SubjectOverride.proj("override_person_id")
    confirmed = decided & "choice_status != 'MANUAL' and chosen_person_id = override_person_id" & restriction
    for row in confirmed.to_dicts():
        key = {k: row[k] for k in SubjectChoice.primary_key}
        reason = f"Person {row['override_person_id']} was chosen by hand, as automatically before."
        SubjectChoice.update1({**key, "choice_status": "MANUAL", "choice_reason": reason})
    differs = decided & "chosen_person_id is null or chosen_person_id != override_person_id"
    withdrawn = (SubjectChoice & {"choice_status": "MANUAL"}) - SubjectOverride
    outdated = SubjectChoice & [differs.proj(), withdrawn.proj()] & restriction
    return delete_below(SubjectChoice, outdated.keys())


# ------------------------------------------------------------------------------------------------------- files, rows
def save_tracking(tracking: lib.Tracking, path: Path) -> None:
    """Write all tracks of a video to one npz, float32 but for the time stamps."""
    t, people = len(tracking.time_s), tracking.persons
    stack = {
        "box_px": np.zeros((len(people), t, 4), np.float32),
        "roi_px": np.zeros((len(people), t, 4), np.float32),
        "score": np.zeros((len(people), t), np.float32),
        "observed": np.zeros((len(people), t), bool),
    }
    for i, person in enumerate(people):
        for name, array in stack.items():
            array[i] = getattr(person, name)
    ids = np.asarray([p.person_id for p in people], np.int16)
    np.savez_compressed(path, time_s=np.asarray(tracking.time_s, np.float64), person_id=ids, **stack)


def load_tracking(path: Path, size_px: tuple[int, int], detector: str, model_sha256: str) -> lib.Tracking:
    """The `Tracking` from the npz that `save_tracking` wrote and the row's figures. Raises FILE_FORMAT."""
    from pbl_pipeline import tracking as lib

    data = load_npz(path, needed=("time_s", "person_id", "box_px", "roi_px", "score", "observed"))
    n, t = data["person_id"].size, data["time_s"].size
    shapes = {"time_s": (t,), "person_id": (n,), "box_px": (n, t, 4), "roi_px": (n, t, 4)}
    check_numbers(path, data, {**shapes, "score": (n, t), "observed": (n, t)})
    people = tuple(
        lib.PersonTrack(int(p), data["box_px"][i], data["roi_px"][i], data["score"][i], data["observed"][i])
        for i, p in enumerate(data["person_id"])
    )
    return lib.Tracking(data["time_s"], size_px, people, detector, model_sha256)
