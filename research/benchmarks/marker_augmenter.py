"""Accuracy of the marker augmenter at the pelvis: laboratories' markers, recorded motions, and our fits of two clips.

    python -m research.benchmarks.marker_augmenter                       # laboratories and motions
    python -m research.benchmarks.marker_augmenter --fits FOLDER         # and fits: real_clips --save FOLDER

Reads `../shared/data/real/{marker_ik,motions,video_mocap}`; the README there has sources and licences. The 15 points
are those of a body that was fitted to all of a laboratory's markers, of recorded joint angles put on our body, or of
our fit of a video. The pelvis is turned onto the augmenter's four iliac spines (least squares, sites of `opencap_35`).

1. Laboratories: distance of the augmenter's markers from the recorded ones, and error of the pelvis' tilt.
2. Motions, a row a person and activity: tilt as recorded and as the augmenter has it, mean and standard deviation over
   time; correlation over time; the slope over the persons who walk. The body is that of the recording: this is the
   network alone.
3. Clips: error of hip flexion with the fit's own pelvis and with the augmenter's, the femurs being the fit's: sd of the
   error (no constant counts), its mean, and the mean absolute error. `--headings 1` asks for one heading, as OpenCap
   does.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import click
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import body_poses, load_body, marker_positions, marker_set
from pbl_pipeline.fit import METHODS, TrialFit, fit_session
from pbl_pipeline.fit.augmented_pelvis import pelvis_of
from pbl_pipeline.keypoints import AugmenterParams, MarkerAugmenter
from research.benchmarks import marker_ik
from research.benchmarks.real_clips import CLIPS, fitted_angles, recorded_angles, score
from research.corpus.motions import read_motions
from research.paths import SHARED

BODY, SITES, SEEN = load_body(), marker_set("opencap_35"), marker_set("halpe_26")
PELVIS = BODY.body_names.index("pelvis")
#: Markers that a laboratory has under OpenCap's names, by our names.
RECORDED = {n: n.replace("l_", "L_").replace("L_ASIS", "L.ASIS").replace("L_PSIS", "L.PSIS") for n in SITES.names}
RECORDED |= {"r_ASIS": "r.ASIS", "r_PSIS": "r.PSIS", "r_shoulder": "R_Shoulder", "l_shoulder": "L_Shoulder"}
LONGEST_S = 8.0


def points(qpos: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(T, 15, 3) what the augmenter wants, on the body."""
    x = np.asarray(marker_positions(BODY, SEEN, qpos, scale, np.zeros((len(SEEN), 3))))
    return x[:, [SEEN.names.index(n) for n in MarkerAugmenter.points]]


def tilt_deg(pelvis: np.ndarray) -> np.ndarray:
    """Angle of the pelvis' forward axis below the level (deg; OpenSim's sign: an anterior tilt is negative)."""
    return np.degrees(np.arcsin(pelvis[:, 2, 0]))


def laboratories(augmenter: MarkerAugmenter) -> None:
    table = marker_ik.marker_table()
    for walk in marker_ik.WALKS:
        trial = marker_ik.markers_of(walk, table)
        fit = fit_session([trial], [walk], METHODS["markers"], markers=table).trials[0]
        found = augmenter(fit.time_s, points(fit.qpos, fit.scale)).xyz_world_m
        click.echo(f"\n{walk}: distance from the recorded marker, mm (both sides)")
        groups = defaultdict(list)
        for i, name in enumerate(augmenter.markers):
            if RECORDED[name] in trial.names and "thigh" not in name and "_sh" not in name.replace("_shoulder", ""):
                apart = found[:, i] - trial.xyz_world_m[:, trial.names.index(RECORDED[name])]
                groups[name.split("_")[-1]].append(1000 * np.linalg.norm(apart, axis=1).mean())
        click.echo("  " + "  ".join(f"{n} {np.mean(v):.0f}" for n, v in groups.items()))
        true = np.asarray(body_poses(BODY, fit.qpos, fit.scale)[1])[:, PELVIS]
        error = tilt_deg(pelvis_of(found)) - tilt_deg(true)
        click.echo(f"  pelvic tilt: error mean {error.mean():.1f}, sd {error.std():.1f} deg")


def motions(augmenter: MarkerAugmenter) -> None:
    rows: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
    for motion in read_motions(SHARED / "real" / "motions"):
        part = motion.time_s <= motion.time_s[0] + LONGEST_S
        qpos = np.asarray(motion.qpos)[part]
        found = augmenter(np.asarray(motion.time_s)[part], points(qpos, np.ones(8))).xyz_world_m
        true, has = (
            tilt_deg(np.asarray(body_poses(BODY, qpos, np.ones(8))[1])[:, PELVIS]),
            tilt_deg(pelvis_of(found)),
        )
        known = np.isfinite(has)
        if np.std(true[known]) > 1e-3:  # a pelvis that was measured
            rows[motion.person, motion.activity].append((true[known], has[known]))
    click.echo(f"\n{'person':32}{'activity':14}{'tilt':>7}{'sd':>6}{'augmenter':>11}{'error sd':>10}{'r':>7}")
    walkers = []
    for (person, activity), trials in rows.items():
        figures = [(t.mean(), t.std(), h.mean(), (h - t).std(), np.corrcoef(t, h)[0, 1]) for t, h in trials]
        true, sd, has, error, r = np.mean(figures, axis=0)
        click.echo(f"{person[:31]:32}{activity:14}{true:7.1f}{sd:6.1f}{has:11.1f}{error:10.1f}{r:7.2f}")
        if activity == "walk":
            walkers.append((true, has))
    true, has = np.array(walkers).T
    click.echo(
        f"{len(true)} persons who walk: slope {np.polyfit(true, has, 1)[0]:.2f}, r {np.corrcoef(true, has)[0, 1]:.2f}, "
        f"sd of the tilt {np.std(true):.1f}, of the error {np.std(has - true):.1f} deg"
    )


def clips(folder: Path, augmenter: MarkerAugmenter) -> None:
    for clip in CLIPS:
        truth = recorded_angles(SHARED / "real" / "video_mocap" / clip / "sample_mocap.json.gz")
        for path in sorted(folder.glob(f"{clip}.*.fit.npz")):
            fit = TrialFit.load(path)
            rows = np.isfinite(fit.qpos[:, 0])
            time_s, qpos = np.asarray(fit.time_s)[rows], fit.qpos[rows]
            found = augmenter(time_s, points(qpos, fit.scale))
            rotation = np.asarray(body_poses(BODY, qpos, fit.scale)[1])
            lag = score(fitted_angles(fit), truth).lag_s
            inside = (time_s - lag >= truth[0][0]) & (time_s - lag <= truth[0][-1])
            click.echo(f"\n{path.name}: {'; '.join(found.assumed)}")
            for name, pelvis in (
                ("the fit's pelvis", rotation[:, PELVIS]),
                ("augmenter", pelvis_of(found.xyz_world_m)),
            ):
                errors = []
                for side in "rl":
                    femur = rotation[:, BODY.body_names.index(f"femur_{side}")]
                    flexion = Rotation.from_matrix(np.swapaxes(pelvis, 1, 2) @ femur).as_euler("ZXY", degrees=True)[
                        :, 0
                    ]
                    errors.append(
                        (flexion - np.interp(time_s - lag, truth[0], truth[1][f"hip_flexion_{side}"]))[inside]
                    )
                sd, mean, absolute = np.std(errors, axis=1), np.mean(errors, axis=1), np.mean(np.abs(errors), axis=1)
                click.echo(
                    f"  hip flexion, {name:18} sd {sd.mean():.2f} (right {sd[0]:.1f}, left {sd[1]:.1f}); mean "
                    f"{mean[0]:.1f}, {mean[1]:.1f}; absolute {absolute.mean():.2f} deg"
                )


@click.command()
@click.option("--fits", type=click.Path(path_type=Path, exists=True, file_okay=False), help="Fits of the clips.")
@click.option("--headings", type=int, default=AugmenterParams().headings, show_default=True)
def main(fits: Path | None, headings: int) -> None:
    """Print the three tables."""
    augmenter = MarkerAugmenter(AugmenterParams(headings=headings))
    if fits is not None:
        clips(fits, augmenter)
    laboratories(augmenter)
    motions(augmenter)


if __name__ == "__main__":
    main()
