"""`pbl detect`: people, choice of the subject and keypoints of one video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbl_pipeline.errors import PblError

if TYPE_CHECKING:
    from pbl_pipeline.tracking import SubjectChoice, Tracking

_EPILOG = "Example: pbl detect walk.mp4 --out walk.keypoints.npz --person auto"


class _Person(click.ParamType):
    name = "auto|N"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int | None:
        if value is None or value == "auto" or isinstance(value, int):
            return value if isinstance(value, int) else None
        if isinstance(value, str) and value.isdecimal():
            return int(value)
        return self.fail(f"{value!r} is neither 'auto' nor the number of a person", param, ctx)


@click.command(epilog=_EPILOG)
@click.argument("video", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="keypoints.npz to write.")
@click.option("--camera", type=click.Path(path_type=Path), help="Calibration file; without it a phone is guessed.")
@click.option("--person", type=_Person(), default="auto", show_default=True, help="Whom to measure.")
def detect(video: Path, out: Path, camera: Path | None, person: int | None) -> None:
    """Find the people in VIDEO, choose the one to measure, and write that person's keypoints.

    Where no one is clearly the subject, nothing is measured: a picture with the numbered people is written beside OUT,
    and the command is to be called again with --person N.
    """
    from pbl_pipeline.keypoints import check_keypoints, detect_keypoints
    from pbl_pipeline.tracking import choose_subject, save_contact_sheet, time_in_view_s, track_people
    from pbl_pipeline.video import guess_camera, load_camera, probe

    if out.suffix != ".npz":
        raise click.BadParameter(f"{out} does not end in .npz", param_hint="--out")
    info = probe(video)
    size = (info.width_px, info.height_px)
    lens = load_camera(camera, size) if camera else guess_camera(info)
    tracking = track_people(video)
    out.parent.mkdir(parents=True, exist_ok=True)
    choice = choose_subject(tracking, override=person)
    for p in tracking.persons:
        seconds = time_in_view_s(p, tracking.time_s)
        click.echo(f"person {p.person_id}: in view for {seconds:.1f} s, score {choice.scores[p.person_id]:.2f}")
    click.echo(f"{choice.status}: {choice.reason}")
    if choice.status == "NO_PERSON":
        raise PblError(
            "TRACK_NO_PERSON",
            found="no person in any frame",
            expected="a person who takes at least about a fifth of the picture's height",
            next_step="film from nearer, in light, so that the whole body is in the picture",
            key=str(video),
        )
    if choice.person_id is None:
        sheet = save_contact_sheet(video, tracking, out.with_name(out.name.removesuffix(".npz") + ".persons.png"))
        raise _needs_choice(video, tracking, choice, sheet)
    keypoints = detect_keypoints(video, tracking, choice.person_id, lens)
    keypoints.save(out)
    seen = keypoints.confidence.max(axis=1) > 0
    click.echo(
        f"{out}: {len(keypoints.names)} points ({keypoints.marker_set}) of person {choice.person_id} "
        f"in {int(seen.sum())} of {len(seen)} frames; camera {lens.source}"
    )
    for check in check_keypoints(keypoints):
        if check.advice:
            click.echo(f"  {check.outcome} {check.check} = {check.value:.3g}: {check.advice}")


def _needs_choice(video: Path, tracking: Tracking, choice: SubjectChoice, sheet: Path) -> PblError:
    ranked = sorted(choice.scores, key=lambda k: -choice.scores[k])
    named = ", ".join(f"{k} (score {choice.scores[k]:.2f})" for k in ranked)
    return PblError(
        "SUBJECT_NEEDS_CHOICE",
        found=f"{len(tracking.persons)} people, none clearly the subject: person {named}",
        expected="one person who walks, is in view longer, or is larger than the others",
        next_step=f"look at {sheet} and call again with --person N, for example --person {ranked[0]}",
        key=str(video),
    )
