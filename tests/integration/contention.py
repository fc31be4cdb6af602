"""A process that takes jobs from the same queue as others at the same time."""

from typing import Any


def work(gate: Any, said: Any) -> None:
    """Wait for the others at `gate`, take jobs of VideoInfo one by one until none is left; put them in `said`."""
    import pbl_schemas
    from pbl_schemas import video
    from pbl_workers import queue, run_job

    pbl_schemas.activate(methods=False)
    gate.wait(240)
    done: list[int] = []
    while jobs := queue.claim(video.VideoInfo, 1):
        assert run_job.run(jobs[0]).what == run_job.DONE
        done.append(int(jobs[0].key["video_id"]))
    said.put(done)
