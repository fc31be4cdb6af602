"""Walks and other tasks of `pbl_pipeline.synthetic`, whose feet stand still: one part of the training corpus.

The motions come from a least-squares solution that needs MuJoCo (a second each), so they are made once, by
`python -m research.events --make-solved FILE`, and carried to where the model is trained.
"""

from __future__ import annotations

import numpy as np

from ._sequence import GRID_HZ, POINTS, Bout, Sequence

#: What is asked for, and how much of it (fraction of the sequences).
_TASKS = (
    ("walk", 0.72),
    ("tug", 0.14),
    ("four_square", 0.05),
    ("sit_to_stand", 0.04),
    ("squat", 0.03),
    ("standing", 0.02),
)
_SECONDS = 9.0


def solved_sequence(seed: int) -> Sequence:
    """One synthetic person doing one task. The same seed gives the same sequence."""
    from pbl_pipeline import synthetic

    rng = np.random.default_rng([seed, 601])
    task = str(rng.choice([t for t, _ in _TASKS], p=[p for _, p in _TASKS]))
    names = list(synthetic.IMPAIRMENTS)
    n = int(rng.choice(4, p=[0.35, 0.35, 0.2, 0.1]))
    impairments = []
    for name in rng.choice(names, n, replace=False):
        side = str(rng.choice(["right", "left"])) if name in ("stiff_knee", "drop_foot", "weakness") else ""
        impairments.append(synthetic.Impairment(str(name), float(rng.uniform(0.1, 1.0)), side))
    speed = float(np.clip(rng.normal(1.15, 0.4), 0.35, 2.2)) if rng.random() < 0.7 else None
    spec = synthetic.SynthSpec(
        task=task,
        seed=seed,
        impairments=tuple(impairments),
        camera="panned",
        seconds=None if task in ("tug", "four_square") else _SECONDS,
        fps=GRID_HZ,
        speed_m_per_s=speed,
        noise="none",
    )
    truth = synthetic.synthesise(spec).truth
    at = {n: i for i, n in enumerate(_names(spec.marker_set))}
    bml = truth.markers_world_m
    plain = synthetic.true_markers(truth.qpos, "blazepose_33", truth.scale)
    blaze = {n: i for i, n in enumerate(_names("blazepose_33"))}
    xyz = np.empty((len(truth.time_s), len(POINTS), 2, 3))
    for s, (side, letter) in enumerate((("left", "l"), ("right", "r"))):
        for i, name in enumerate(("hip", "knee", "ankle", "heel")):
            xyz[:, i, s] = plain[:, blaze[f"{side}_{name}"]]
        xyz[:, 4, s] = 0.5 * (bml[:, at[f"{letter}firstmetatarsal"]] + bml[:, at[f"{letter}fifthmetatarsal"]])
        xyz[:, 5, s] = plain[:, blaze[f"{side}_foot_index"]]
    bouts: tuple[Bout, ...] = ()
    if task in ("walk", "tug"):
        events = {k: [] for k in ("left foot_down", "right foot_up", "right foot_down", "left foot_up")}
        for e in truth.events:
            events[f"{e.side} {e.event}"].append(e.time_s)
        bouts = (Bout(tuple(np.array(v) for v in events.values()), open_ends=task == "walk"),)
    return Sequence(xyz.astype(np.float32), bouts, kind=f"solved {task}")


def _names(marker_set_name: str) -> tuple[str, ...]:
    from pbl_pipeline.body import marker_set

    return tuple(marker_set(marker_set_name).names)
