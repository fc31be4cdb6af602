"""The transformer: from the joints of both legs over a window to the phases of the four events, in Equinox."""

from __future__ import annotations

import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from .features import N_FEATURES

#: Outputs per frame: (cosine, sine) of each event's phase in the order left down, right up, right down, left up, then
#: the logit of walking.
N_OUTPUTS = 9


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Size of the network: width of a token, blocks, heads, width of the hidden layer, frames of the convolutions."""

    width: int = 128
    blocks: int = 4
    heads: int = 4
    hidden: int = 384
    kernel: int = 5


class Block(eqx.Module):
    """Attention over the window's frames, then a hidden layer, each on normalised tokens and added to them."""

    norm_attention: eqx.nn.LayerNorm
    queries_keys_values: eqx.nn.Linear
    mix: eqx.nn.Linear
    norm_hidden: eqx.nn.LayerNorm
    into: eqx.nn.Linear
    out: eqx.nn.Linear
    heads: int = eqx.field(static=True)

    def __init__(self, size: Architecture, key: PRNGKeyArray) -> None:
        k = jax.random.split(key, 4)
        self.norm_attention = eqx.nn.LayerNorm(size.width)
        self.queries_keys_values = eqx.nn.Linear(size.width, 3 * size.width, use_bias=False, key=k[0])
        self.mix = eqx.nn.Linear(size.width, size.width, key=k[1])
        self.norm_hidden = eqx.nn.LayerNorm(size.width)
        self.into = eqx.nn.Linear(size.width, size.hidden, key=k[2])
        self.out = eqx.nn.Linear(size.hidden, size.width, key=k[3])
        self.heads = size.heads

    def __call__(self, x: Float[Array, "T D"], seen: Bool[Array, " T"]) -> Float[Array, "T D"]:
        t, d = x.shape
        q, k, v = jnp.split(jax.vmap(self.queries_keys_values)(jax.vmap(self.norm_attention)(x)), 3, axis=1)
        q, k, v = (part.reshape(t, self.heads, d // self.heads) for part in (q, k, v))
        q, k = _turned(q), _turned(k)
        score = jnp.einsum("qhd,khd->hqk", q, k) / np.sqrt(d // self.heads)
        weight = jax.nn.softmax(jnp.where(seen[None, None, :], score, -1e9), axis=-1)
        together = jnp.einsum("hqk,khd->qhd", weight, v).reshape(t, d)
        x = x + jax.vmap(self.mix)(together)
        return x + jax.vmap(self.out)(jax.nn.gelu(jax.vmap(self.into)(jax.vmap(self.norm_hidden)(x))))


class PhaseTransformer(eqx.Module):
    """Two convolutions over neighbouring frames, then blocks of attention; one window at a time (`jax.vmap` for more).

    Positions enter only as differences (rotary embedding), so that a window may begin anywhere in a stride.
    """

    first: eqx.nn.Conv1d
    second: eqx.nn.Conv1d
    blocks: tuple[Block, ...]
    norm: eqx.nn.LayerNorm
    head: eqx.nn.Linear
    size: Architecture = eqx.field(static=True)

    def __init__(self, size: Architecture, key: PRNGKeyArray) -> None:
        k = jax.random.split(key, size.blocks + 3)
        self.first = eqx.nn.Conv1d(N_FEATURES, size.width, size.kernel, padding="SAME", key=k[0])
        self.second = eqx.nn.Conv1d(size.width, size.width, size.kernel, padding="SAME", key=k[1])
        self.blocks = tuple(Block(size, k[i + 3]) for i in range(size.blocks))
        self.norm = eqx.nn.LayerNorm(size.width)
        self.head = eqx.nn.Linear(size.width, N_OUTPUTS, key=k[2])
        self.size = size

    def __call__(self, features: Float[Array, "T F"], seen: Bool[Array, " T"]) -> Float[Array, "T 9"]:
        x = self.first(features.T)
        x = (x + self.second(jax.nn.gelu(x))).T
        for block in self.blocks:
            x = block(x, seen)
        return jax.vmap(self.head)(jax.vmap(self.norm)(x))


def _turned(x: Float[Array, "T H D"]) -> Float[Array, "T H D"]:
    """Rotary position embedding (Su et al. 2021): pairs of channels turn with the frame's number."""
    t, _, d = x.shape
    rate = 1.0 / (1000.0 ** (np.arange(d // 2) / (d // 2)))
    angle = np.arange(t)[:, None, None] * rate
    c, s = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
    a, b = x[..., : d // 2], x[..., d // 2 :]
    return jnp.concatenate([a * c - b * s, a * s + b * c], axis=-1)


def save_model(path: str | Path, model: PhaseTransformer, about: dict[str, Any]) -> None:
    """Write weights as float16 and `about` (model card, calibration) to one npz."""
    named = {k: np.asarray(v, np.float16) for k, v in _named(eqx.filter(model, eqx.is_array)).items()}
    text = json.dumps({**about, "architecture": dataclasses.asdict(model.size)}, sort_keys=True)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.array(text), allow_pickle=False, **named)
    Path(path).write_bytes(buffer.getvalue())


def load_model(path: str | Path) -> tuple[PhaseTransformer, dict[str, Any]]:
    """The model and its metadata."""
    with np.load(path, allow_pickle=False) as f:
        about = json.loads(str(f["about"]))
        arrays = {k: np.asarray(f[k], np.float32) for k in f.files if k not in ("about", "allow_pickle")}
    size = Architecture(**about["architecture"])
    empty = eqx.filter_eval_shape(PhaseTransformer, size, jax.random.key(0))
    names = list(_named(eqx.filter(empty, lambda x: isinstance(x, jax.ShapeDtypeStruct))))
    leaves, tree = jax.tree.flatten(empty)
    if sorted(names) != sorted(arrays) or len(leaves) != len(names):
        raise ValueError("the weights are not those of this architecture")
    return jax.tree.unflatten(tree, [jnp.asarray(arrays[n]) for n in names]), about


def _named(tree: Any) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
