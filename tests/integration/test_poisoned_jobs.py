"""A job that cannot succeed ends: deleted where nobody asks for it, else an error row with a code, after 3 attempts."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbl_pipeline.video
from pbl_pipeline.errors import PblError, said
from pbl_schemas import connection, fit, gait, keypoints, tracking, video
from pbl_schemas.job_errors import error_message, stored_error
from pbl_schemas.jobs import jobs_of
from pbl_schemas.reading.why import why
from pbl_workers import queue, requeue, run_job
from tests import Faults
from tests.rows import register

from . import web
from .jobs import first_job, queued, work


def claimed(table: Any) -> queue.Claim:
    """The only job of a table; what it waits for is over."""
    jobs = jobs_of(table)
    jobs.connection.query(f"UPDATE {jobs.full_table_name} SET scheduled_time = '2020-01-01'")
    (job,) = queue.claim(table, 1)
    return job


def error(table: Any) -> tuple[str, str]:
    """Code and finding of the only error row of a table."""
    stored = stored_error(jobs_of(table).errors.fetch1("error_message"))
    return stored.code, stored.found


def test_a_file_whose_name_is_a_word_of_datajoint_is_one_error(tables: None, tmp_path: Path):
    """Errors were told apart by their text, and "fetch1" in it meant: again, for ever."""
    path = tmp_path / "fetch1 Referential integrity failed.mp4"
    path.write_bytes(os.urandom(4096))
    register(path)
    assert work().failed == 1
    assert error(video.VideoInfo)[0] == "VIDEO_NOT_A_VIDEO"
    assert work().failed == 0


def test_a_video_that_was_deleted_while_its_job_was_queued_is_not_tried(tables: None, tmp_path: Path, stand_in):
    number = queued(tmp_path, video.VideoInfo)
    video.Video.delete(prompt=False)
    stand_in(probe=lambda path: pytest.fail("tried"))
    outcome = run_job.run(claimed(video.VideoInfo))
    assert (outcome.what, outcome.job.key) == (run_job.VANISHED, {"video_id": number})
    assert len(jobs_of(video.VideoInfo)) == 0


def test_a_video_that_was_deleted_while_it_was_computed_leaves_no_job(tables: None, tmp_path: Path, stand_in):
    queued(tmp_path, video.VideoInfo)
    real = pbl_pipeline.video.probe

    def probe(path):
        video.Video.delete(prompt=False)
        return real(path)

    stand_in(probe=probe)
    assert run_job.run(claimed(video.VideoInfo)).what == run_job.VANISHED
    assert (len(jobs_of(video.VideoInfo)), len(video.VideoInfo())) == (0, 0)


def test_a_selection_that_was_withdrawn_is_not_tried(tables: None, tmp_path: Path):
    queued(tmp_path, fit.SessionFit)
    (key,) = fit.FitSelection.keys()
    fit.FitSelection.update1({**key, "fit_current": False})
    assert run_job.run(claimed(fit.SessionFit)).what == run_job.VANISHED
    assert len(jobs_of(fit.SessionFit)) == 0


def test_a_row_that_a_result_needs_is_gone_for_good(tables: None, tmp_path: Path):
    queued(tmp_path, fit.SessionFit)
    body = fit.BodyModel.to_dicts()
    fit.BodyModel.delete(prompt=False)
    try:
        for attempt in range(1, run_job.ATTEMPTS):
            assert run_job.run(claimed(fit.SessionFit)).what == run_job.LATER
            job = jobs_of(fit.SessionFit).fetch1()
            assert (job["status"], job["attempts"]) == ("pending", attempt)
            now = connection.connect().query("SELECT CURRENT_TIMESTAMP(3)").fetchone()[0]
            delay = (job["scheduled_time"] - now).total_seconds()
            assert run_job.RETRY_S[attempt - 1] - 5.0 < delay <= run_job.RETRY_S[attempt - 1]
            assert "body_model" in job["error_message"]
        assert run_job.run(claimed(fit.SessionFit)).what == run_job.FAILED
        code, found = error(fit.SessionFit)
        assert code == "INPUT_CHANGED"
        assert "body_model" in found
        assert work().failed == 0  # and it stays an error row
        assert len(jobs_of(fit.SessionFit).errors) == 1
    finally:
        fit.BodyModel.insert(body)
    assert requeue.retry(table="SessionFit") == {"SessionFit": 1}  # counts from the beginning
    assert jobs_of(fit.SessionFit).fetch1("attempts") == 0
    assert run_job.run(claimed(fit.SessionFit)).what == run_job.DONE


def test_inputs_that_change_each_time_end_as_an_error(tables: None, tmp_path: Path, stand_in):
    number = queued(tmp_path, video.VideoInfo)
    real, names = pbl_pipeline.video.probe, iter("abc")

    def probe(path):
        # As if somebody renamed the file again and again; it is the same one for the probe.
        elsewhere = tmp_path / f"{next(names)}.mp4"
        os.rename(path, elsewhere)
        video.Video.update1({"video_id": number, "video_path": str(elsewhere)})
        return real(elsewhere)

    stand_in(probe=probe)
    ended = [run_job.run(claimed(video.VideoInfo)).what for _ in range(run_job.ATTEMPTS)]
    assert ended == [run_job.LATER, run_job.LATER, run_job.FAILED]
    assert error(video.VideoInfo)[0] == "INPUT_CHANGED"


@pytest.mark.parametrize(
    ("table", "column", "reader"),
    [
        (video.VideoInfo, "frame_time", tracking.Tracking),
        (tracking.Tracking, "tracks", tracking.SubjectChoice),
        (keypoints.Keypoints, "keypoints_file", fit.TrialInput),
        (fit.SessionFit.Trial, "trial_file", gait.GaitEvents),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_damaged_file_of_the_store_is_an_error_that_names_it(tables, tmp_path: Path, table, column, reader):
    queued(tmp_path, reader)
    stored = table.fetch1(column).path
    file = Path(connection.store_backend().spec["location"]) / stored
    content = file.read_bytes()
    # A zip whose size is right and whose content is not has its own check sums.
    for damaged in (content[: len(content) // 2], b"\x93NUMPY" + os.urandom(len(content) - 6), None):
        if damaged is None:
            file.unlink()
        else:
            file.write_bytes(damaged)
        assert work(reader).failed == 1
        code, found = error(reader)
        assert code == "FILE_FORMAT", found
        assert stored in jobs_of(reader).errors.fetch1("error_message")
        assert work(reader).failed == 0
        assert requeue.retry(table=reader.__name__) == {reader.__name__: 1}


def test_an_unforeseen_error_outside_of_the_computation_has_a_code(tables: None, tmp_path: Path, faults: Faults):
    queued(tmp_path, video.VideoInfo)

    faults(video.VideoInfo, "make_insert", np.linalg.LinAlgError("Singular matrix"))
    outcome = run_job.run(claimed(video.VideoInfo))
    assert (outcome.what, outcome.code) == (run_job.FAILED, "INTERNAL")
    assert error(video.VideoInfo) == ("INTERNAL", "LinAlgError: Singular matrix")
    assert len(video.VideoInfo()) == 0


def test_plain_populate_reports_a_missing_row_with_its_code(tables: None, tmp_path: Path):
    """DataJoint writes the name of the exception before its text."""
    queued(tmp_path, fit.SessionFit)
    body = fit.BodyModel.to_dicts()
    fit.BodyModel.delete(prompt=False)
    try:
        fit.SessionFit.populate(reserve_jobs=True, suppress_errors=True)
        assert error(fit.SessionFit)[0] == "INPUT_CHANGED"
        assert len(queue.errors_of(fit.SessionFit, "INPUT_CHANGED")) == 1
        assert len(queue.errors_of(fit.SessionFit, "FILE_FORMAT")) == 0
    finally:
        fit.BodyModel.insert(body)


def test_an_error_of_a_job_is_german_and_whole_on_pages(tables: None, tmp_path: Path):
    job = first_job(tmp_path, "gang")
    found = said("trial {name}: {found}", name="gang", found=said("strides of {s:.2g} s", s=0.125))
    step = "correct the times of the frames, in seconds (the rate of the recording)"
    queue.fail(job, error_message(PblError("FIT_INPUT", found, "0.6 to 4 s", step), "VideoInfo", job.key))
    browser = web.client(role="reviewer,operator")
    browser.headers["accept-language"] = "de"
    for path in ("/visits/1", "/recordings/1", "/operate"):
        assert "Aufnahme gang: Doppelschritte von 0,12 s" in browser.get(path).text, path
    assert "ie Zeiten der Bilder berichtigen" in browser.get("/visits/1").text
    assert why(1).verdict.startswith("reading of the video failed (FIT_INPUT: trial gang: strides of 0.12 s)")


def test_an_error_without_german_words_has_no_english_ones_on_german_pages(tables: None, tmp_path: Path):
    job = first_job(tmp_path, "gang")
    broken = PblError("INTERNAL", "a value that no person foresaw", "another", "see what it was")
    queue.fail(job, error_message(broken, "VideoInfo", job.key))
    browser = web.client(role="reviewer,operator")
    for path in ("/visits/1", "/recordings/1", "/operate"):
        pages = {name: browser.get(path, headers={"accept-language": name}).text for name in ("en", "de")}
        assert "foresaw" in pages["en"], path
        assert "Einzelheiten stehen auf der englischen Seite" in pages["de"], path
        assert "foresaw" not in pages["de"], path
