"""Bordered block-banded systems: one small block per frame, coupled to the two frames on either side, and a border.

    | A  B | |x|   |g|      A (F Q, F Q): block (t, t) full, (t, t+1) full, (t, t+2) diagonal
    | B' C | |y| = |h|      B (F Q, K), C (K, K): what all frames share (scale, marker offsets, clocks, floors)

Solved by the Schur complement of A, whose pairs of frames form a block tridiagonal matrix: block cyclic reduction (e.g.
Golub & Van Loan, Matrix Computations, 4th ed., 4.5.4) halves their number until at most `CHAIN` are left, and block
Cholesky elimination takes these one after the other. Work and memory grow linearly with F. On a CPU the chain takes all
pairs: one loop, which compiles once and needs half of the operations. On a GPU it is short, and the number of steps one
after the other grows with log F. All matrices are symmetric positive definite. No library has this structure.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax.linalg import triangular_solve
from jaxtyping import Array, Float

#: Columns of the border that are processed at once where memory counts: for the variances, and in long sessions.
COLUMNS = 32
#: Most pairs of frames that are eliminated one after the other, by JAX platform.
CHAIN = {"cpu": 2**31, "gpu": 8}
#: Numbers of a border above which it is eliminated some columns at a time, which takes less than half of the memory.
LARGE_BORDER = 2**26


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BorderedBandedSystem:
    """The matrix. F must be even; `next_1[t]` couples t (rows) with t + 1 (columns), the diagonal `next_2[t]` t with t
    + 2 (0 beyond the end).
    """

    diagonal: Float[Array, "F Q Q"]
    next_1: Float[Array, "F Q Q"]
    next_2: Float[Array, "F Q"]
    border: Float[Array, "F Q K"]
    corner: Float[Array, "K K"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Level:
    """Result of one level of the reduction: with block = L L', the inverse of L and its product with the links to the
    blocks before (the first n columns) and after."""

    inverse: Float[Array, "M n n"]
    sides: Float[Array, "M n 2*n"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class _Chain:
    """Blocks eliminated one after the other: with block = L L' when its predecessors are gone, the inverse of L and its
    product with the link to the block after."""

    inverse: Float[Array, "M n n"]
    after: Float[Array, "M n n"]


class _Factors(NamedTuple):
    """Factors of A: the levels of the reduction, then the chain of the remaining blocks."""

    levels: list[_Level]
    chain: _Chain


def solve(
    matrix: BorderedBandedSystem, g: Float[Array, "F Q"], h: Float[Array, " K"]
) -> tuple[Float[Array, "F Q"], Float[Array, " K"]]:
    """x (F, Q) and y (K,) of the system above."""
    with jax.default_matmul_precision("highest"):
        factors = _factors(matrix)
        if matrix.border.size > LARGE_BORDER:
            reduced = _substitute(factors, g[..., None]).reshape(1, -1) @ matrix.border.reshape(g.size, -1)
            y = _solve_corner(matrix.corner - _by_columns(factors, matrix.border), h - reduced[0])
            return _substitute(factors, (g - matrix.border @ y)[..., None])[..., 0], y
        # The border and g are eliminated together, and the eliminated rows are used again for x.
        rows = _eliminated(factors, jnp.concatenate([matrix.border, g[..., None]], axis=-1))
        both = _grams(rows)
        y = _solve_corner(matrix.corner - both[:-1, :-1], h - both[:-1, -1])
        x = _back_substituted(factors, [r[..., -1:] - r[..., :-1] @ y[:, None] for r in rows], g.shape[0])
        return x.reshape(g.shape), y


def marginal_variance(matrix: BorderedBandedSystem) -> tuple[Float[Array, "F Q"], Float[Array, " K"]]:
    """Diagonal of the inverse of the whole matrix: that of x and that of y."""
    with jax.default_matmul_precision("highest"):
        shape, k = matrix.border.shape[:2], matrix.border.shape[-1]
        factors = _factors(matrix)
        large = matrix.border.size > LARGE_BORDER
        rows = [] if large else _eliminated(factors, matrix.border)
        inverse = _inverse_of_factor(matrix.corner - (_by_columns(factors, matrix.border) if large else _grams(rows)))
        groups = jnp.pad(inverse, [(0, -k % COLUMNS), (0, 0)]).reshape(-1, COLUMNS, k)

        def add(total: Array, some: Array) -> tuple[Array, None]:
            if large:
                x = _substitute(factors, matrix.border @ some.T)
            else:
                x = _back_substituted(factors, [r @ some.T for r in rows], shape[0])
            return total + jnp.sum(x.reshape(*shape, -1) ** 2, axis=-1), None

        shared, _ = jax.lax.scan(add, jnp.zeros(shape, inverse.dtype), groups)
        return _inverse_diagonal(factors, shape) + shared, jnp.sum(inverse**2, axis=0)


def _solve_corner(schur: Float[Array, "K K"], h: Float[Array, " K"]) -> Float[Array, " K"]:
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(schur), True), h)


def _inverse_of_factor(matrix: Float[Array, "*m n n"]) -> Float[Array, "*m n n"]:
    """Inverse of the lower Cholesky factor. Products with it are faster than many triangular solutions."""
    lower = jnp.linalg.cholesky(matrix)
    eye = jnp.broadcast_to(jnp.eye(matrix.shape[-1], dtype=matrix.dtype), matrix.shape)
    return triangular_solve(lower, eye, left_side=True, lower=True)


def _factors(matrix: BorderedBandedSystem) -> _Factors:
    blocks, links = _pairs(matrix)
    most = CHAIN.get(jax.default_backend(), CHAIN["gpu"])
    levels: list[_Level] = []
    while blocks.shape[0] > most:
        level, blocks, links = _reduce(blocks, links)
        levels.append(level)

    def eliminate(after: Array, block_and_link: tuple[Array, Array]) -> tuple[Array, _Chain]:
        block, link = block_and_link
        inverse = _inverse_of_factor(block - after.T @ after)
        after = inverse @ link
        return after, _Chain(inverse, after)

    return _Factors(levels, jax.lax.scan(eliminate, jnp.zeros_like(blocks[0]), (blocks, links))[1])


def _grams(rows: list[Float[Array, "M n R"]]) -> Float[Array, "R R"]:
    """r' A^-1 r of a right-hand side r, from its eliminated rows."""
    return functools.reduce(jnp.add, [jnp.einsum("mnk,mnl->kl", y, y) for y in rows])


def _by_columns(factors: _Factors, border: Float[Array, "F Q K"]) -> Float[Array, "K K"]:
    """B' A^-1 B."""
    k = border.shape[-1]
    width = min(COLUMNS, k)
    starts = np.minimum(np.arange(0, k, width), k - width)  # the last ones overlap

    def some(start: Array) -> Array:
        x = _substitute(factors, jax.lax.dynamic_slice_in_dim(border, start, width, axis=2))
        return x.reshape(-1, width).T @ border.reshape(-1, k)

    rows = jax.lax.map(some, jnp.asarray(starts)).reshape(-1, k)
    return rows[np.unique(starts[:, None] + np.arange(width), return_index=True)[1]]


def _eliminated(factors: _Factors, rhs: Float[Array, "F Q R"]) -> list[Float[Array, "M n R"]]:
    """The eliminated rows of a right-hand side, level by level and last those of the chain."""
    part, out = _in_pairs(rhs), []
    for level in factors.levels:
        y, part = _forward(level, part)
        out.append(y)

    def eliminate(from_before: Array, block_and_rows: tuple[_Chain, Array]) -> tuple[Array, Array]:
        block, rows = block_and_rows
        y = block.inverse @ (rows - from_before)
        return block.after.T @ y, y

    return [*out, jax.lax.scan(eliminate, jnp.zeros_like(part[0]), (factors.chain, part))[1]]


def _pairs(matrix: BorderedBandedSystem) -> tuple[Array, Array]:
    """Blocks (F/2, 2Q, 2Q) of pairs of frames and the links (F/2, 2Q, 2Q) of each pair with the next one."""
    f, q = matrix.next_2.shape
    eye = jnp.eye(q, dtype=matrix.next_2.dtype)
    own = matrix.diagonal.reshape(f // 2, 2, q, q)
    next_1 = matrix.next_1.reshape(f // 2, 2, q, q)
    next_2 = matrix.next_2.reshape(f // 2, 2, q, 1) * eye
    blocks = jnp.block([[own[:, 0], next_1[:, 0]], [jnp.swapaxes(next_1[:, 0], -1, -2), own[:, 1]]])
    links = jnp.block([[next_2[:, 0], jnp.zeros_like(next_1[:, 1])], [next_1[:, 1], next_2[:, 1]]])
    return blocks, links


def _in_pairs(rows: Float[Array, "F Q R"]) -> Float[Array, "M n R"]:
    return rows.reshape(rows.shape[0] // 2, 2 * rows.shape[1], rows.shape[2])


def _split(rows: Array) -> tuple[Array, Array]:
    """Rows 0, 2, 4 ... and rows 1, 3, 5 ... of an even number of them, without the cost of strided copies."""
    both = rows.reshape(rows.shape[0] // 2, 2, *rows.shape[1:])
    return both[:, 0], both[:, 1]


def _join(even: Array, odd: Array) -> Array:
    return jnp.stack([even, odd], axis=1).reshape(2 * even.shape[0], *even.shape[1:])


def _even(rows: Array, fill: Array) -> Array:
    return jnp.concatenate([rows, fill[None]]) if rows.shape[0] % 2 else rows


def _earlier(rows: Array) -> Array:
    """Each row's predecessor, zeros before the first."""
    return jnp.concatenate([jnp.zeros_like(rows[:1]), rows[:-1]])


def _later(rows: Array) -> Array:
    """Each row's successor, zeros after the last."""
    return jnp.concatenate([rows[1:], jnp.zeros_like(rows[:1])])


def _reduce(blocks: Array, links: Array) -> tuple[_Level, Array, Array]:
    """Eliminate every other block (0, 2, 4 ...); the rest stays, linked anew. Block i stays right of eliminated i."""
    n = blocks.shape[-1]
    gone, stay = _split(_even(blocks, jnp.eye(n, dtype=blocks.dtype)))
    after, before = _split(_even(links, jnp.zeros((n, n), links.dtype)))
    inverse = _inverse_of_factor(gone)
    sides = inverse @ jnp.concatenate([jnp.swapaxes(_earlier(before), -1, -2), after], axis=-1)
    both = _gram(sides, sides)
    stay = stay - both[:, n:, n:] - _later(both[:, :n, :n])
    return _Level(inverse, sides), stay, -_later(both[:, :n, n:])


def _forward(level: _Level, rhs: Float[Array, "M n R"]) -> tuple[Array, Array]:
    """The eliminated rows of a right-hand side at a level, and the rows that stay."""
    n = rhs.shape[1]
    gone, stay = _split(_even(rhs, jnp.zeros_like(rhs[0])))
    y = level.inverse @ gone
    both = _gram(level.sides, y)
    return y, stay - both[:, n:] - _later(both[:, :n])


def _gram(a: Array, b: Array) -> Array:
    return jnp.einsum("mkn,mkr->mnr", a, b)


def _substitute(factors: _Factors, rhs: Float[Array, "F Q R"]) -> Float[Array, "F Q R"]:
    """A^-1 rhs with the factors of A."""
    return _back_substituted(factors, _eliminated(factors, rhs), rhs.shape[0]).reshape(rhs.shape)


def _back_substituted(factors: _Factors, rows: list[Float[Array, "M n R"]], frames: int) -> Float[Array, "P n R"]:
    """The solution for pairs of frames, from the eliminated rows of a right-hand side."""

    def substitute(later: Array, block_and_rows: tuple[_Chain, Array]) -> tuple[Array, Array]:
        block, y = block_and_rows
        x = block.inverse.T @ (y - block.after @ later)
        return x, x

    x = jax.lax.scan(substitute, jnp.zeros_like(rows[-1][0]), (factors.chain, rows[-1]), reverse=True)[1]
    for level, y in zip(reversed(factors.levels), reversed(rows[:-1]), strict=True):
        x = x[: y.shape[0]]  # an odd number of blocks was filled up
        gone = _gram(level.inverse, y - level.sides @ jnp.concatenate([_earlier(x), x], axis=1))
        x = _join(gone, x)
    return x[: frames // 2]


def _inverse_diagonal(factors: _Factors, shape: tuple[int, ...]) -> Float[Array, "F Q"]:
    """Diagonal of A^-1 by the same recursion backwards, which needs only the blocks between neighbours."""
    n = factors.chain.inverse.shape[-1]

    def invert(later: Array, block: _Chain) -> tuple[Array, tuple[Array, Array]]:
        to_later = -block.inverse.T @ block.after
        link = to_later @ later
        own = block.inverse.T @ block.inverse + link @ to_later.T
        return own, (own, link)

    # link[i]: covariance of block i with block i + 1
    none = jnp.zeros_like(factors.chain.inverse[0])
    _, (own, link) = jax.lax.scan(invert, none, factors.chain, reverse=True)
    for level in reversed(factors.levels):
        count = level.inverse.shape[0]
        own, link = own[:count], link[:count]
        # Covariance of an eliminated block's two neighbours, of the block with them, then its own.
        left, between = _earlier(own), _earlier(link)
        neighbours = jnp.block([[left, between], [jnp.swapaxes(between, -1, -2), own]])
        to_sides = -_gram(level.inverse, level.sides)
        beside = to_sides @ neighbours
        gone = _gram(level.inverse, level.inverse) + beside @ jnp.swapaxes(to_sides, -1, -2)
        with_left, with_right = beside[..., :n], beside[..., n:]
        own, link = _join(gone, own), _join(with_right, _later(jnp.swapaxes(with_left, -1, -2)))
    frames = shape[0] // 2
    return jnp.diagonal(own[:frames], axis1=-2, axis2=-1).reshape(shape)
