"""`pbl detect`: people, choice of the subject and keypoints of one video."""

from __future__ import annotations

from pathlib import Path

import click

from .options import DEVICE, KEYPOINTS, PEOPLE, Person, keypoint_method, tracking_method


@click.command(epilog="Example: pbl detect walk.mp4 --out walk.keypoints.npz --person auto")
@click.argument("video", type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="keypoints.npz to write.")
@click.option("--camera", type=click.Path(path_type=Path), help="Calibration file; without it a phone is assumed.")
@click.option("--attitude", type=click.Path(path_type=Path), help="Sensor log of the phone (docs/phone_capture.md).")
@click.option("--person", type=Person(), default="auto", show_default=True, help="ID of the person to measure.")
@PEOPLE
@KEYPOINTS
@DEVICE
def detect(
    video: Path,
    out: Path,
    camera: Path | None,
    attitude: Path | None,
    person: int | None,
    people: str | None,
    keypoints: str | None,
    device: str | None,
) -> None:
    """Find the people in VIDEO, choose the one to measure, and write that person's keypoints.

    If no one is clearly the subject, nothing is measured: a picture with the numbered people is written next to OUT;
    call the command again with --person N. With --attitude the keypoints include the phone's orientation, so that the
    fit knows the direction of gravity and the movement of the camera.
    """
    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.keypoints import check_keypoints, confidence_text, detect_keypoints, visibility
    from pbl_pipeline.tracking import choose_subject, require_subject, time_in_view_s, track_people
    from pbl_pipeline.video import check_timing, find_camera, load_attitude, probe

    if out.suffix != ".npz":
        raise click.BadParameter(f"{out} does not end in .npz", param_hint="--out")
    info = probe(video)
    lens = find_camera(info, camera)
    check_out_file(out)
    log = load_attitude(attitude, info) if attitude else None
    method, finder = keypoint_method(keypoints, device), tracking_method(people)
    tracking = track_people(video, finder, info=info)
    choice = choose_subject(tracking, override=person)
    for p in tracking.persons:
        seconds = time_in_view_s(p, tracking.time_s)
        click.echo(f"person {p.person_id}: in view for {seconds:.1f} s, score {choice.scores[p.person_id]:.2f}")
    click.echo(f"{choice.status}: {choice.reason}")
    sheet = out.with_name(out.name.removesuffix(".npz") + ".persons.png")
    subject = require_subject(choice, tracking, video, sheet)
    found = detect_keypoints(video, tracking, subject, lens, params=method)
    if log is not None:
        found = found.with_attitude(log)
    found.save(out)
    seen = found.confidence.max(axis=1) > 0
    click.echo(
        f"{out}: {len(found.names)} points ({found.marker_set}) of person {subject} "
        f"in {int(seen.sum())} of {len(seen)} frames; camera {lens.source}"
    )
    if found.origin:
        click.echo(f"  keypoints by {found.origin}")
    if log is not None:
        span = f"{len(log.time_s)} samples from {log.time_s[0]:.2f} to {log.time_s[-1]:.2f} s of the video"
        click.echo(f"  orientation of the phone: {span}; {log.source}")
    for note in info.notes:
        click.echo(f"  {note}")
    click.echo(f"  {visibility(found).text()}")
    click.echo(f"  confidence: {confidence_text(found)}")
    for check in (*check_timing(info), *check_keypoints(found)):
        if check.advice:
            click.echo(f"  {check.outcome} {check.check} = {check.value:.3g}: {check.advice}")
