"""The job with a known answer that every working process does before it takes real ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_schemas.connection import store_backend
from pbl_schemas.store import check_store

from . import registry

#: Largest median error of the fit on the synthetic trial without noise (deg); it is 0.4 where all is well.
FIT_DEG = 1.5
#: Largest error of the cadence (steps/min) on the synthetic walk; it is below 1.
CADENCE_PER_MIN = 3.0


class SelfTestFailed(Exception):
    """Raised if this machine computes wrong results, or cannot reach what it needs."""


def check(tables: Sequence[Any]) -> None:
    """Write and read the store, and do known jobs of the resource classes that are served: real ones then find the
    networks loaded and the programs of that size compiled. Raises SelfTestFailed with the expected and found values."""
    served = {registry.stage_of(t).resource for t in tables}
    _store()
    if registry.FIT in served:
        _fit()
    if registry.LIGHT in served:
        _cadence()


def _store() -> None:
    try:
        check_store(store_backend())
    except PblError as error:
        raise SelfTestFailed(f"the store cannot be written and read: {error.found}") from error


def _fit() -> None:
    from pbl_pipeline.fit import METHODS, fit_session
    from pbl_pipeline.synthetic import SynthSpec, synthesise

    made = synthesise(SynthSpec(seed=1, seconds=2.0, noise="none"))
    fit = fit_session([made.keypoints], ["selftest"], METHODS["gauss-newton"]).trials[0]
    error = float(np.nanmedian(np.degrees(np.abs(fit.qpos[:, 6:] - made.truth.qpos[:, 6:]))))
    if not error <= FIT_DEG:
        raise SelfTestFailed(f"the fit of the known walk is {error:.2f} deg off, expected at most {FIT_DEG:g}")


def _cadence() -> None:
    from pbl_pipeline.gait import detect_events, feet_from_keypoints
    from pbl_pipeline.synthetic import SynthSpec, synthesise

    made = synthesise(SynthSpec(seed=1, seconds=6.0, noise="none"))
    found = detect_events(feet_from_keypoints(made.keypoints))

    def cadence(events: Sequence[Any]) -> float:
        downs = np.sort([e.time_s for e in events if e.event == "foot_down"])
        return 60.0 / float(np.mean(np.diff(downs[1:-1]))) if len(downs) > 4 else float("nan")

    expected, measured = cadence(made.truth.events), cadence(found.events)
    if not abs(expected - measured) <= CADENCE_PER_MIN:
        raise SelfTestFailed(f"cadence of the known walk {measured:.1f}, expected {expected:.1f} steps/min")
