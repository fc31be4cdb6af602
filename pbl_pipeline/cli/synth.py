"""`pbl synth`: a synthetic trial with known truth."""

from __future__ import annotations

from pathlib import Path

import click


@click.command(
    epilog="Example: pbl synth --out trials --seed 3 --impairment crouch:0.7 --view sagittal --camera handheld"
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder for the files.")
@click.option("--name", help="Name of the files (default: from the options).")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of person, motion, hand and noise.")
@click.option(
    "--task",
    type=click.Choice(["walk", "standing", "sit_to_stand", "squat", "tug", "four_square"]),
    default="walk",
    show_default=True,
)
@click.option(
    "--impairment",
    "impairments",
    metavar="NAME[:SEVERITY[:SIDE]]",
    multiple=True,
    help="crouch, stiff_knee, drop_foot, short_steps, weakness, trunk_sway or widened_base, with a severity of 0 to 1 "
    "(default 1) and right, left or both, where it may be on one side. Repeat for several.",
)
@click.option(
    "--view", type=click.Choice(["frontal", "oblique", "sagittal", "follow"]), default="frontal", show_default=True
)
@click.option(
    "--camera",
    type=click.Choice(["static", "panned", "handheld"]),
    default="static",
    show_default=True,
    help="Panned and handheld include the phone's orientation log.",
)
@click.option("--marker-set", default="bml_movi_87", show_default=True, help="Points of the detector.")
@click.option("--seconds", type=float, help="Default: 5 for walk, standing; 10 for others; whole tug, four_square.")
@click.option("--fps", type=float, default=30.0, show_default=True)
@click.option(
    "--speed", metavar="M/S|GROUP", help="m/s, or very_slow, slow, free, fast, very_fast (default: the person's)."
)
@click.option("--ground", type=click.Choice(["overground", "treadmill"]), default="overground", show_default=True)
@click.option("--noise", type=click.Choice(["benchmark", "memory", "none"]), default="benchmark", show_default=True)
def synth(
    out: Path,
    name: str | None,
    seed: int,
    task: str,
    impairments: tuple[str, ...],
    view: str,
    camera: str,
    marker_set: str,
    seconds: float | None,
    fps: float,
    speed: str | None,
    ground: str,
    noise: str,
) -> None:
    """Make a trial whose joint angles, gait events, body and camera are known.

    Writes NAME.keypoints.npz as `pbl detect`, NAME.truth.npz and NAME.events.csv; see docs/synth.md.
    """
    from pbl_pipeline.files import check_out_folder
    from pbl_pipeline.synthetic import Impairment, SynthSpec, speed_of_group, synthesise

    check_out_folder(out)
    spec = SynthSpec(
        task=task,
        seed=seed,
        impairments=tuple(Impairment.parse(text) for text in impairments),
        view=view,
        camera=camera,
        marker_set=marker_set,
        seconds=seconds,
        fps=fps,
        speed_m_per_s=None if speed is None else _speed(speed, seed, speed_of_group),
        ground=ground,
        noise=noise,
    )
    made = synthesise(spec)
    paths = made.save(out, name)
    k = made.keypoints
    click.echo(f"{paths[0]}: {len(k.time_s)} frames, {len(k.names)} points, {len(made.truth.events)} gait events")
    for path in paths[1:]:
        click.echo(f"{path}")


def _speed(text: str, seed: int, of_group) -> float:
    try:
        return float(text)
    except ValueError:
        return of_group(text, seed)
