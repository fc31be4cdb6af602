"""A person's choice who is measured, and its consequences."""

from __future__ import annotations

from pbl_pipeline.errors import PblError

from . import tracking, video
from ._base import resolve_method


def choose_person(video_id: int, person: int, tracking_method: str | None = None) -> dict[str, int]:
    """Measure `person` of a video: write the override and delete what was computed for somebody else.

    Both happen in one transaction. An error row of the choice (a number that did not exist) becomes pending again.

    Returns
    -------
    dict
        Table name to number of deleted rows.

    Raises
    ------
    PblError
        DB_NOT_FOUND for a video that is not registered, SUBJECT_UNKNOWN_PERSON, SOLVER_UNKNOWN.
    """
    if not video.Video & {"video_id": video_id}:
        raise unknown_video(video_id)
    key: dict = {"video_id": video_id}
    if tracking_method is not None:
        key["tracking_method"] = resolve_method(tracking.TrackingMethod, "tracking", tracking_method)
    selections = (tracking.TrackingSelection & key).keys()
    failed = tracking.SubjectChoice.jobs  # declares the job table, which would end a transaction
    connection = tracking.schema.connection
    assert connection is not None
    with connection.transaction:
        for selection in selections:
            tracking.set_override(selection, person)
            (failed.errors & selection).delete_quick()
        return tracking.drop_outdated_choices(key)


def unknown_video(video_id: int) -> PblError:
    """DB_NOT_FOUND for a number that no video has."""
    return PblError(
        "DB_NOT_FOUND",
        found=f"no video_id {video_id}",
        expected="a registered video",
        next_step="`pbl ingest` prints the numbers of videos, and `pbl status` those that wait for a choice",
    )
