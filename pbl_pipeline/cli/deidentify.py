"""`pbl deidentify`: a copy of a video in which no one can be recognised."""

from __future__ import annotations

from pathlib import Path

import click

#: Most runs of frames that are printed; the sidecar has them all.
_MOST_RUNS = 10


@click.command(epilog="Example: pbl deidentify walk.mp4 --out shared/P017.mp4 --keep device")
@click.argument("video", type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), help="Video to write (.mp4); else VIDEO.deidentified.mp4.")
@click.option(
    "--how",
    type=click.Choice(["blur", "pixelate", "skeleton"]),
    default="blur",
    show_default=True,
    help="Hide the heads, or draw the keypoints of the bodies on black.",
)
@click.option(
    "--keep",
    type=click.Choice(["place", "device", "time"]),
    multiple=True,
    help="Metadata to keep; repeatable.",
)
@click.option("--overwrite", is_flag=True, help="Replace files of these names.")
def deidentify(video: Path, out: Path | None, how: str, keep: tuple[str, ...], overwrite: bool) -> None:
    """Write a copy of VIDEO in which the heads of all people are hidden, without sound and metadata.

    Frames and time stamps are those of VIDEO, so that results computed from VIDEO belong to both; measure VIDEO, not
    the copy, in which detectors miss the faces. A .deidentified.json next to the copy lists the frames that are not
    certain: review these before you pass the copy on. docs/privacy.md states how often a head is covered.
    """
    from pbl_pipeline.deidentify import REASONS, check_call
    from pbl_pipeline.deidentify import deidentify as run
    from pbl_pipeline.errors import PblError

    out = out or video.with_name(f"{video.stem}.deidentified.mp4")
    check_call(video, out, how, keep, overwrite)
    done = run(video, out, how, keep=keep, overwrite=overwrite)
    click.echo(f"{done.status}: {done.reason}")
    for first, last in done.uncertain[:_MOST_RUNS]:
        click.echo(f"  frames {first} to {last}: {'; '.join(REASONS[r] for r in done.why(first, last))}")
    if len(done.uncertain) > _MOST_RUNS:
        click.echo(f"  and {len(done.uncertain) - _MOST_RUNS} more ranges")
    click.echo(f"{done.path}\n{done.sidecar}")
    if done.status == "NO_HEAD":
        raise PblError(
            "HEAD_NOT_FOUND",
            found=f"no head in {len(done.reasons)} frames; {done.path.name} was written, and "
            + ("nothing is drawn in it" if how == "skeleton" else "nothing in it is covered"),
            expected="a person whose head is in the picture",
            next_step="look at the whole video before you pass it on; --how skeleton shows no picture at all",
            key=str(video),
        )
