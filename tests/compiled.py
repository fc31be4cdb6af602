"""Programs that tests compile."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def little_optimised() -> Iterator[None]:
    """For what compiles much and computes little: XLA takes a third of the time for the same formulas."""
    import jax

    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", False)
