"""Copies of the recordings in which no one can be recognised."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.names import shortened
from pbl_pipeline.temporary import TemporaryFolder, new_folder

from . import video
from .datajoint_setup import dj
from .origin import Origin, computes, origin_columns
from .rows import one
from .stored_files import file_ref, stored_file

if TYPE_CHECKING:
    from pbl_pipeline import deidentify as lib

schema = dj.Schema()


@schema
class Deidentified(dj.Computed):
    definition = f"""
    # a video with hidden heads, where PBL_DEIDENTIFY asks for it; overlays and reports show its pictures
    -> video.VideoInfo
    ---
    deidentified_how         : enum('blur', 'pixelate', 'skeleton')  # how heads are hidden; skeleton: keypoints on black
    deidentified_status      : enum('CERTAIN', 'REVIEW', 'NO_HEAD')  # REVIEW: some frames are to be looked at; NO_HEAD: nothing was covered
    deidentified_reason      : varchar(1000)    # the status in words
    deidentified_heads       : int32            # heads that were found, false ones included
    deidentified_uncertain   : int32            # frames that are not certain
    deidentified_ranges      : json             # runs of these: first and last frame (from 0), and why
    deidentified_sha256      : char(64)         # of the bytes of the copy
    deidentified_file        : <object@arrays>  # mp4 without sound and metadata, frame by frame as the recording; docs/privacy.md
    {origin_columns("deidentified")}
    index (deidentified_status)
    """  # noqa: E501

    @staticmethod
    def wanted() -> bool:
        """Return whether the setting asks for copies."""
        return bool(settings.deidentify_how())

    @property
    def key_source(self) -> Any:
        """Recordings with pictures if the setting asks for copies, else none."""
        return video.VideoInfo.proj() & self.wanted()

    def make_fetch(self, key: dict) -> tuple:
        probed = one(video.Video * video.VideoInfo & key)
        return probed, file_ref(probed.pop("frame_time"))

    @computes
    def make_compute(
        self, key: dict, probed: Mapping[str, Any], times: dict
    ) -> tuple[lib.Deidentified, TemporaryFolder, str]:
        from pbl_pipeline.deidentify import deidentify

        how = settings.deidentify_how()
        if not how:
            raise PblError(
                "USAGE",
                found="PBL_DEIDENTIFY is not set on this machine",
                expected="blur, pixelate or skeleton",
                next_step="set it as on the machine that queued the job, then `pbl retry`",
            )
        path = video.registered_file(probed["video_path"], probed["video_sha256"], key)
        with stored_file(times) as stored:
            info = video.info_of_row(probed, np.load(stored, allow_pickle=False))
        folder = new_folder()
        done = deidentify(path, folder.path / "deidentified.mp4", how, info=info)
        return done, folder, sha256_of(done.path)

    def make_insert(
        self, key: dict, done: lib.Deidentified, folder: TemporaryFolder, sha256: str, origin: Origin
    ) -> None:
        # The folder goes with the object: an insert that meets a deadlock is tried again.
        assert folder.path.is_dir()
        row = {
            "how": done.how,
            "status": done.status,
            "reason": shortened(done.reason, 1000),
            "heads": done.n_heads,
            "uncertain": done.n_uncertain,
            "ranges": [{"first": a, "last": b, "why": list(done.why(a, b))} for a, b in done.uncertain],
            "sha256": sha256,
            "file": done.path,
        }
        own = {f"deidentified_{name}": value for name, value in row.items()}
        self.insert1({**key, **own, **origin.row("deidentified")})


def copy_of(video_id: int) -> str:
    """Return the SHA-256 of the de-identified copy of a recording, empty without one."""
    return "".join(str(h) for h in (Deidentified & {"video_id": video_id}).to_arrays("deidentified_sha256"))


@contextlib.contextmanager
def shown(video_id: int) -> Iterator[Path | None]:
    """The recording whose pictures overlays and reports show: the de-identified copy where PBL_DEIDENTIFY asks for it,
    None if it does not.

    Raises `PblError` DB_NOT_FOUND: such a copy does not exist yet. HEAD_NOT_FOUND: nothing was covered in it.
    """
    from pbl_pipeline.deidentify import nothing_covered

    how = settings.deidentify_how()
    if not how:
        yield None
        return
    key = {"video_id": video_id}
    rows = (Deidentified & key).to_dicts()
    if not rows or rows[0]["deidentified_how"] != how:
        again = "`pbl reprocess --table Deidentified --yes`, then `pbl populate`" if rows else "`pbl populate`"
        raise PblError(
            "DB_NOT_FOUND",
            found=f"a copy by {rows[0]['deidentified_how']}" if rows else "no de-identified copy of the video",
            expected=f"one by {how}, which PBL_DEIDENTIFY asks for",
            next_step=f"compute it: {again}",
            key=f"video_id={video_id}",
        )
    if rows[0]["deidentified_status"] == "NO_HEAD" and how != "skeleton":
        raise nothing_covered(key=f"video_id={video_id}")
    with stored_file(file_ref(rows[0]["deidentified_file"])) as path:
        yield path
