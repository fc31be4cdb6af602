"""Programs that tests compile."""

import contextlib
from collections.abc import Iterator
from unittest import mock


@contextlib.contextmanager
def little_optimised() -> Iterator[None]:
    """For what compiles much and computes little: XLA takes a third of the time for the same formulas."""
    import jax

    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", False)


@contextlib.contextmanager
def packed_in(
    frames: int | None = None, markers: int | None = None, trials: int | None = None, least_trials: int = 1
) -> Iterator[None]:
    """For sessions that are packed in arrays of these sizes; None as the library does."""
    from pbl_pipeline.fit import problem

    real = {name: getattr(problem, name) for name in ("pad_frames", "pad_markers", "pad_trials")}

    def pad_trials(n: int, coarse: bool = False) -> int:
        return trials or max(least_trials, real["pad_trials"](n, coarse))

    with mock.patch.multiple(
        problem,
        pad_frames=lambda n, coarse=False: frames or real["pad_frames"](n, coarse),
        pad_markers=lambda n: markers or real["pad_markers"](n),
        pad_trials=pad_trials,
    ):
        yield
