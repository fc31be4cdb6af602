"""Training of the phase transformer: examples are made and augmented on the device, all from one seed."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from pbl_pipeline.gait.events.network.transformer import Architecture, PhaseTransformer

from ._augment import SOURCE, augment
from ._corpus import UNIT_M, Corpus


@dataclasses.dataclass(frozen=True)
class TrainParams:
    """Parameters of the training. `solved_share`: examples from solved motions, where the corpus has such. `minutes`:
    fewer steps where more would take longer; the history says how many there were."""

    seed: int = 0
    steps: int = 30000
    batch: int = 256
    learning_rate: float = 1e-3
    warm_up: int = 500
    weight_decay: float = 0.01
    clip: float = 1.0
    average: float = 0.999
    walking_weight: float = 0.25
    solved_share: float = 0.35
    report_every: int = 500
    validation: int = 2048
    minutes: float | None = None


def train(
    corpus: Corpus,
    size: Architecture,
    params: TrainParams,
    say: Callable[[str], None],
    checkpoint: Callable[[PhaseTransformer, dict[str, Any]], None],
) -> tuple[PhaseTransformer, list[dict[str, Any]]]:
    """The averaged model and the history of its metrics. `checkpoint` is called at each report."""
    key = jax.random.key(params.seed)
    k_model, k_valid, key = jax.random.split(key, 3)
    model = PhaseTransformer(size, k_model)
    weights, static = eqx.partition(model, eqx.is_array)
    optimiser = optax.chain(
        optax.clip_by_global_norm(params.clip),
        optax.scale_by_adam(),
        optax.add_decayed_weights(params.weight_decay),
    )
    data = {k: jnp.asarray(getattr(corpus, k)) for k in ("points", "phase", "walks", "start", "length")}
    picks = _picks(corpus, held_out=False, solved_share=params.solved_share)
    n = sum(a.size for a in jax.tree.leaves(weights))
    say(f"{n} weights; {len(corpus.start)} sequences, {len(corpus.walks) / 50 / 3600:.1f} h, on {jax.devices()[0]}")

    def loss_of(weights: Any, data: Any, key: Any) -> Any:
        batch = _batch(key, data, picks, params.batch)
        return _loss(eqx.combine(weights, static), batch, params.walking_weight)

    @jax.jit
    def some_steps(state: Any, data: Any, done: Any, total: Any, keys: Any) -> Any:
        def step(state: Any, now: Any) -> Any:
            key, number = now
            weights, average, optimiser_state = state
            rate = _rate(number, total, params)
            loss, slope = jax.value_and_grad(loss_of)(weights, data, key)
            update, optimiser_state = optimiser.update(slope, optimiser_state, weights)
            weights = optax.apply_updates(weights, jax.tree.map(lambda u: -rate * u, update))
            average = optax.incremental_update(weights, average, 1 - params.average)
            return (weights, average, optimiser_state), loss

        return jax.lax.scan(step, state, (keys, done + jnp.arange(len(keys))))

    state = (weights, weights, optimiser.init(weights))
    validation = _validation(corpus, k_valid, params.validation)
    history: list[dict[str, Any]] = []
    chunk = min(50, params.report_every)
    total = _fitting_steps(lambda k: some_steps(state, data, 0, params.steps, k), key, chunk, params, say)
    began, done = time.monotonic(), 0
    losses: list[np.ndarray] = []
    while done < total:
        key, k = jax.random.split(key)
        state, loss = some_steps(state, data, done, total, jax.random.split(k, chunk))
        losses.append(np.asarray(loss))
        done += chunk
        if done % params.report_every < chunk or done >= total:
            mean = float(np.concatenate(losses).mean())
            losses = []
            # Early on the average still holds the start.
            shown = state[1] if done > 5 / (1 - params.average) else state[0]
            metrics = {"step": done, "of": total, "loss": mean, "seconds": time.monotonic() - began}
            metrics |= validation(eqx.combine(shown, static))
            history.append(metrics)
            say("  ".join(f"{k} {v:.4g}" for k, v in metrics.items()))
            checkpoint(eqx.combine(shown, static), metrics)
            if not np.isfinite(mean):
                raise FloatingPointError(f"the loss is {mean} after {done} steps")
    final = state[1] if done > 5 / (1 - params.average) else state[0]
    return eqx.combine(final, static), history


def _rate(number: Any, total: Any, params: TrainParams) -> Any:
    """Learning rate: up within the first steps, then down along half a cosine to a hundredth."""
    warm = jnp.minimum(params.warm_up, total // 4 + 1)
    fraction = jnp.clip((number - warm) / jnp.maximum(total - warm, 1), 0.0, 1.0)
    down = 0.01 + 0.99 * 0.5 * (1 + jnp.cos(jnp.pi * fraction))
    return params.learning_rate * jnp.minimum(number / warm, down)


def _fitting_steps(run: Callable[[Any], Any], key: Any, chunk: int, params: TrainParams, say: Any) -> int:
    """Return the number of steps: those asked for, or as many as fit into the minutes."""
    keys = jax.random.split(key, chunk)
    began = time.monotonic()
    jax.block_until_ready(run(keys))
    compiled = time.monotonic()
    jax.block_until_ready(run(keys))
    step_s = (time.monotonic() - compiled) / chunk
    minutes = params.steps * step_s / 60
    say(f"compiled in {compiled - began:.0f} s, {1000 * step_s:.1f} ms a step, {minutes:.1f} min in all")
    if params.minutes is None:
        return params.steps
    fits = int(60 * params.minutes / (1.05 * step_s)) // chunk * chunk
    if fits < params.steps:
        say(f"{fits} steps fit into {params.minutes:g} minutes")
    return max(chunk, min(params.steps, fits))


def _loss(model: PhaseTransformer, batch: dict[str, Any], walking_weight: float) -> Any:
    out = jax.vmap(model)(batch["features"], batch["seen"])
    off = jnp.sum((out[..., :8].reshape(batch["target"].shape) - batch["target"]) ** 2, axis=-1)
    phase = jnp.sum(jnp.where(batch["defined"], off, 0.0)) / (jnp.sum(batch["defined"]) + 1.0)
    entropy = optax.sigmoid_binary_cross_entropy(out[..., 8], 1.0 * batch["walks"])
    walking = jnp.sum(jnp.where(batch["seen"], entropy, 0.0)) / (jnp.sum(batch["seen"]) + 1.0)
    return phase + walking_weight * walking


def _picks(corpus: Corpus, *, held_out: bool, solved_share: float) -> tuple[np.ndarray, np.ndarray]:
    """Sequences to draw from, and how likely each is, cumulated."""
    use = corpus.part(held_out)
    solved = np.char.startswith(corpus.kind[use], "solved")
    fraction = np.where(solved, solved_share / max(solved.sum(), 1), (1 - solved_share) / max((~solved).sum(), 1))
    return use.astype(np.int32), (np.cumsum(fraction) / fraction.sum()).astype(np.float32)


def _batch(key: Any, data: Any, picks: tuple[np.ndarray, np.ndarray], n: int) -> dict[str, Any]:
    k_which, k_where, k_augment = jax.random.split(key, 3)
    which = jnp.searchsorted(jnp.asarray(picks[1]), jax.random.uniform(k_which, (n,)))
    which = jnp.asarray(picks[0])[jnp.minimum(which, len(picks[0]) - 1)]
    room = data["length"][which] - SOURCE
    first = data["start"][which] + jnp.floor(jax.random.uniform(k_where, (n,)) * (room + 1)).astype(int)

    def one(key: Any, first: Any) -> dict[str, Any]:
        def cut(x: Any) -> Any:
            return jax.lax.dynamic_slice_in_dim(x, first, SOURCE)

        return augment(key, UNIT_M * cut(data["points"]), cut(data["phase"]), cut(data["walks"]))

    return jax.vmap(one)(jax.random.split(k_augment, n), first)


def _validation(corpus: Corpus, key: Any, n: int) -> Callable[[PhaseTransformer], dict[str, float]]:
    """Metrics on held-out sequences, always the same examples: error of the phase (in thousandths of a turn), of scenes
    and solved motions, and how often walking is told from other things."""
    k_cases, *k_parts = jax.random.split(key, 3)
    del k_cases
    cases = {}
    for name, fraction, k in (("scenes", 0.0, k_parts[0]), ("solved", 1.0, k_parts[1])):
        picks = _picks(corpus, held_out=True, solved_share=fraction)
        if not np.any(np.char.startswith(corpus.kind[picks[0]], "solved")) and name == "solved":
            continue
        own = [np.asarray(p) for p in picks]
        # A part that is small stays small: only the sequences drawn from are sent to the device.
        small = {k: np.asarray(getattr(corpus, k)) for k in ("start", "length")}
        batch = jax.jit(lambda k, d, p=tuple(own): _batch(k, d, p, n))(
            k, {**small, **{f: jnp.asarray(getattr(corpus, f)) for f in ("points", "phase", "walks")}}
        )
        cases[name] = jax.tree.map(np.asarray, batch)
    predict = eqx.filter_jit(lambda model, b: jax.vmap(model)(b["features"], b["seen"]))

    def measure(model: PhaseTransformer) -> dict[str, float]:
        out: dict[str, float] = {}
        for name, batch in cases.items():
            made = [
                np.asarray(predict(model, jax.tree.map(lambda x, i=i: x[i : i + 256], batch))) for i in range(0, n, 256)
            ]
            y = np.concatenate(made)
            found = np.arctan2(y[..., 1:8:2], y[..., 0:8:2])
            true = np.arctan2(batch["target"][..., 1], batch["target"][..., 0])
            off = np.angle(np.exp(1j * (found - true)))[batch["defined"]] / (2 * np.pi)
            right = ((y[..., 8] > 0) == batch["walks"])[batch["seen"]]
            out[f"{name}_median"] = 1000 * float(np.median(np.abs(off)))
            out[f"{name}_p90"] = 1000 * float(np.percentile(np.abs(off), 90))
            out[f"{name}_bias"] = 1000 * float(off.mean())
            out[f"{name}_walking"] = float(right.mean())
        return out

    return measure
