"""`python -m research.events`: make the corpus and train the event model.

    python -m research.events --make-solved solved.npz --solved-count 1500   # needs MuJoCo
    python -m research.events --out DIR --seed 0 --solved solved.npz         # on a GPU, minutes
    python -m research.events --out DIR --calibrate DIR/phase_transformer.npz --solved solved.npz

The second command needs only numpy, scipy, jax, equinox and optax. It writes `phase_transformer.npz` (at each report)
and `metrics.json` to DIR. The third fits the probability of an event on people that training has not seen, minutes on
a CPU, and writes `phase_transformer_calibrated.npz`, which is what detection reads.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import sys
import time
from pathlib import Path


def main(arguments: list[str] | None = None) -> None:
    args = _parser().parse_args(arguments)
    from . import _corpus

    if args.make_solved:
        from ._solved import solved_sequence

        seeds = range(args.solved_first, args.solved_first + args.solved_count)
        _corpus.save(args.make_solved, _corpus.make(solved_sequence, seeds, args.workers, _say))
        _say(f"written: {args.make_solved}")
        return
    args.out.mkdir(parents=True, exist_ok=True)
    if args.calibrate:
        _calibrate(args)
        return
    parts = [_corpus.scenes(args.seed, args.scenes, args.workers, _say)]
    if args.solved:
        parts.append(_corpus.load(args.solved))
    corpus = _corpus.join(*parts)

    import jax

    from pbl_pipeline.gait.events.network.transformer import Architecture, save_model

    from ._train import TrainParams, train

    size = Architecture(width=args.width, blocks=args.blocks, heads=args.heads, hidden=3 * args.width)
    params = TrainParams(
        seed=args.seed,
        steps=args.steps,
        batch=args.batch,
        report_every=args.report_every,
        validation=args.validation,
        minutes=args.minutes,
    )
    about = {
        "train": dataclasses.asdict(params),
        "scenes": args.scenes,
        "solved": sum(str(k).startswith("solved") for k in corpus.kind),
        "device": str(jax.devices()[0].device_kind),
        "jax": jax.__version__,
        "python": platform.python_version(),
        "made": time.strftime("%Y-%m-%d"),
    }
    path = args.out / "phase_transformer.npz"

    def keep(model, metrics) -> None:
        save_model(path, model, {**about, "metrics": metrics})

    _, history = train(corpus, size, params, _say, keep)
    (args.out / "metrics.json").write_text(json.dumps({**about, "history": history}, indent=1) + "\n")
    _say(f"written: {path} ({path.stat().st_size / 1e6:.2f} MB), {args.out / 'metrics.json'}")


def _calibrate(args: argparse.Namespace) -> None:
    """Fit the probability on scenes of other seeds and on the solved motions that training held out."""
    import numpy as np

    from pbl_pipeline.gait.events import METHODS
    from pbl_pipeline.gait.events.network.transformer import load_model, save_model

    from . import _calibrate as calibration
    from . import _corpus

    params = dataclasses.replace(METHODS["phase-transformer"].params, model=str(args.calibrate), model_sha256="")
    fresh = _corpus.scenes(args.seed + 1000, args.calibrate_scenes, args.workers, _say)
    found = list(calibration.cases(fresh, np.arange(len(fresh.start)), params, args.seed))
    if args.solved:
        solved = _corpus.load(args.solved)
        for draw in range(4):
            found += list(calibration.cases(solved, calibration.held_out(solved), params, args.seed + 1 + draw))
    curve, measured = calibration.calibrate(found, params, _say)
    kinds = sorted({c.kind.split()[0] for c in found})
    parts = {k: [c for c in found if c.kind.split()[0] == k] for k in kinds}
    scores = {k: {"sequences": len(v), **calibration.score(v, params)} for k, v in parts.items()}
    for kind, values in scores.items():
        _say(f"{kind}: " + "  ".join(f"{k} {v:.4g}" for k, v in values.items()))
    model, about = load_model(args.calibrate)
    if "probability" in about:
        x, real = calibration.evidence(found, params)
        kept = calibration.reliability(calibration.probability(x, about["probability"]), real)
        _say(f"by the curve in the file: Brier {kept['brier']:.4f}, expected error {kept['expected_error']:.4f}")
    path = args.out / "phase_transformer_calibrated.npz"
    save_model(path, model, {**about, "probability": curve, "reliability": measured, "held_out": scores})
    _say(f"written: {path}")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="python -m research.events",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--out", type=Path, default=Path("event_model"), help="folder for weights and metrics")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--steps", type=int, default=30000)
    p.add_argument("--minutes", type=float, help="at most this long for the steps: fewer of them, if need be")
    p.add_argument("--batch", type=int, default=256)
    p.add_argument("--scenes", type=int, default=20000, help="sequences of 12 s that are made on the spot")
    p.add_argument("--solved", type=Path, help="file of --make-solved")
    p.add_argument("--calibrate", type=Path, help="weights whose events get a probability")
    p.add_argument("--calibrate-scenes", type=int, default=800)
    p.add_argument("--width", type=int, default=128)
    p.add_argument("--blocks", type=int, default=4)
    p.add_argument("--heads", type=int, default=4)
    p.add_argument("--report-every", type=int, default=500, help="steps between reports and checkpoints")
    p.add_argument("--validation", type=int, default=2048, help="held-out examples per report")
    p.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes that make sequences")
    p.add_argument("--make-solved", type=Path, help="only write this corpus of solved motions (needs MuJoCo)")
    p.add_argument("--solved-count", type=int, default=1500)
    p.add_argument("--solved-first", type=int, default=100000, help="seed of the first solved motion")
    return p


if __name__ == "__main__":
    main()
