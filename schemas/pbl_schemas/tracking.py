"""People in a video, and the one who is measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.records import definition, to_row
from pbl_pipeline.results.people import SubjectChoice as Choice
from pbl_pipeline.results.people import TrackFigures
from pbl_pipeline.temporary import new_folder

from . import video
from .datajoint_setup import dj
from .method_rows import method_row, method_table
from .origin import Origin, computes, origin_columns
from .record_parts import part_of
from .rows import delete_below, inside, one, utc_now
from .stored_files import file_ref, read_stored

if TYPE_CHECKING:
    from pbl_pipeline import tracking as lib

schema = dj.Schema()

#: Statuses of a choice that let the chain go on.
CHOSEN = ("CHOSEN", "MANUAL")


TrackingMethod = schema(
    method_table("TrackingMethod", "tracking", "tracking", "person detection, association and choice")
)
SubjectMethod = schema(
    method_table("SubjectMethod", "subject", "subject", "the automatic choice of the measured person")
)


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
        return *video.probed(key), method_row(TrackingMethod, key)

    @computes
    def make_compute(
        self, key: dict, probed: Mapping[str, Any], times: dict, method: Mapping[str, Any]
    ) -> tuple[lib.Tracking, str]:
        from pbl_pipeline.tracking import track_people

        path, info = video.read_probed(probed, times, key)
        tracker = methods.stored(**method)
        return track_people(path, params=tracker, info=info), tracker.hash

    def make_insert(self, key: dict, tracking: lib.Tracking, sha: str, origin: Origin) -> None:
        with new_folder() as folder:
            tracking.save(folder / "tracks.npz")
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
        override = (SubjectOverride & key).to_dicts()
        person = int(override[0]["override_person_id"]) if override else None
        method = method_row(SubjectMethod, one(TrackingSelection & key))
        elsewhere = None if override else _decided_elsewhere(key)
        return file, tracks_of(key), person, elsewhere, method

    @property
    def key_source(self) -> Any:
        return Tracking - video.NotUsable

    @computes
    def make_compute(
        self,
        key: dict,
        file: tuple,
        tracks: tuple,
        override: int | None,
        elsewhere: tuple | None,
        method: Mapping[str, Any],
    ) -> tuple[Choice, bytes | None, str]:
        from pbl_pipeline.tracking import carried_choice, choose_subject, contact_sheet_jpeg

        chooser = methods.stored(**method)
        tracking = load_tracking(*tracks)
        if elsewhere is None:
            choice = choose_subject(tracking, params=chooser, override=override)
        else:
            others, number_there, other_method = elsewhere
            choice = carried_choice(load_tracking(*others), number_there, other_method, tracking, chooser)
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


def tracks_of(key: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[int, int], str, str]:
    """Return the arguments of `load_tracking` for one row of Tracking: what `make_fetch` hands on."""
    row = one(Tracking * video.VideoInfo.proj("width", "height") & key)
    size = int(row["width"]), int(row["height"])
    return file_ref(row["tracks"]), size, row["detector"], row["tracking_model_sha256"]


def load_tracking(ref: Mapping[str, Any], *about: Any) -> lib.Tracking:
    """Return the library's `Tracking` of a file of the store; `about`: as for `Tracking.load`."""
    from pbl_pipeline.tracking import Tracking

    return read_stored(ref, lambda path: Tracking.load(path, *about))


def _decided_elsewhere(key: Mapping[str, Any]) -> tuple | None:
    """Return the last decision about another tracking of this video: its `tracks_of`, the person's number there, the
    method; None without one."""
    others = Tracking * SubjectOverride & {"video_id": key["video_id"]}
    others &= f"tracking_method != '{key['tracking_method']}'"
    for row in others.to_dicts(order_by=["override_created DESC", "tracking_method"]):
        there = {k: row[k] for k in Tracking.primary_key}
        number_there = int(row["override_person_id"])
        if Tracking.Person & there & {"person_id": number_there}:
            return tracks_of(there), number_there, row["tracking_method"]
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
