"""`python -m research.heads`: how many heads of real recordings a de-identified video covers."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(epilog="Example: python -m research.heads --data ../shared/data/real")
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Folder of the recordings in which heads were located (`heads.json`).",
)
@click.option("--clip", "clips", multiple=True, metavar="NAME", help="Only this recording; repeatable.")
def main(data: Path, clips: tuple[str, ...]) -> None:
    """Share of the frames with a head in which `pbl deidentify` covers it.

    The heads were located by eye. Recordings on which the margins were chosen are marked; the total is without them.
    """
    from pbl_pipeline.deidentify import find_heads
    from pbl_pipeline.runs import ranges
    from research.heads.coverage import BAR, frame_coverage, head_coverage, located_clips

    known = located_clips()
    if unknown := set(clips) - {c.name for c in known}:
        raise click.BadParameter(f"{', '.join(sorted(unknown))}; known: {', '.join(c.name for c in known)}")
    chosen = [(c, c.path(data)) for c in known if not clips or c.name in clips]
    total = [0, 0, 0]
    n_certain = n_frames = 0
    click.echo(f"{'recording':12}{'head':18}{'frames':>7}{'covered':>9}{'least':>7}  not covered")
    for clip, path in chosen:
        heads = find_heads(path)
        found = head_coverage(clip, heads)
        for head in found:
            runs = ranges(_flags(head.frames[~head.covered], len(heads.time_s)))
            told = ", ".join(f"{a}-{b}" if b > a else f"{a}" for a, b in runs)
            click.echo(
                f"{clip.name + (' *' if clip.tune else ''):12}{head.who:18}{len(head.frames):7d}"
                f"{head.covered.mean():9.1%}{head.fraction.min():7.0%}  {told}"
            )
        counts = frame_coverage(found)
        certain = sum(not r for r in heads.reasons())
        click.echo(
            f"{'':12}{'all of a frame':18}{counts[0]:7d}{counts[1] / counts[0]:9.1%}{'':7}  "
            f"{certain} of {len(heads.time_s)} frames certain, {counts[2]} of them with a head not covered"
        )
        if not clip.tune:
            total = [a + b for a, b in zip(total, counts, strict=True)]
            n_certain, n_frames = n_certain + certain, n_frames + len(heads.time_s)
    click.echo("* margins and thresholds were chosen with this recording")
    if total[0]:
        share = total[1] / total[0]
        click.echo(
            f"the others: {total[1]} of {total[0]} frames with a head covered ({share:.2%}, wanted {BAR:.1%}); "
            f"{n_certain} of {n_frames} frames certain, {total[2]} of them with a head not covered"
        )


def _flags(frames, n: int):
    """(n,) bool, True at the indices `frames`."""
    import numpy as np

    flags = np.zeros(n, bool)
    flags[frames] = True
    return flags


if __name__ == "__main__":
    main()
