"""The gate for all pairs of two large sets, each pair under its own S_i + S_j, as fast as memory allows.

In two dimensions d2 <= T is a polynomial inequality in the numbers of i and those of j: with S = [[a, b], [b, c]],
innovation (x, y) and det S = a c - b^2,

    c x^2 - 2 b x y + a y^2 - T (a c - b^2) <= 0,

where each of a, b, c, x, y is a sum of a part of i and a part of j. Written out it is a scalar product of twelve
numbers of i with twelve of j, so that all pairs are one matrix product. Pairs that lie within rounding of the border
are decided one by one. More dimensions are first gated in the two that tell most: what fails there fails in all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking.errors import ParameterError
from tracking.gating import Gate, mahalanobis_sq
from tracking.gaussian import Array, cholesky, forward_substitution

BLOCK_BYTES = 1 << 22  # of a block's products
NEGLIGIBLE = 1e-10  # rounding of d2 relative to the threshold that decides no pair
EXACT_AT_ONCE = 100_000  # pairs
BoolArray = NDArray[np.bool_]


def gate_all(
    gate: Gate,
    means: Array,
    covs: Array,
    other_means: Array,
    other_covs: Array,
    counts: ArrayLike | None = None,
    other_counts: ArrayLike | None = None,
) -> BoolArray:
    """Which pairs pass (r, c), of r Gaussians (r, d), (r, d, d) with c others.

    The covariance of a pair's innovation is the sum of both; zero covariances are allowed on one side.

    Raises
    ------
    ParameterError
        Shapes do not fit, or counts are missing where the gate wants them equal.
    CovarianceError
        A covariance that decides a pair is not positive definite.
    """
    a, A, b, B = _checked(gate, means, covs, other_means, other_covs)
    if not (len(a) and len(b)):
        return np.zeros((len(a), len(b)), dtype=bool)
    if gate.dof == 1:
        out = _screen(gate.threshold, *_padded(a, A), *_padded(b, B), exact=(a, A, b, B))
    elif gate.dof == 2:
        out = _screen(gate.threshold, a, A, b, B, exact=(a, A, b, B))
    else:
        out = _many_dimensions(gate.threshold, a, A, b, B)
    if gate.equal_count:
        if counts is None or other_counts is None:
            raise ParameterError("the gate wants equal numbers of members: give counts and other_counts")
        out &= np.asarray(counts)[:, None] == np.asarray(other_counts)
    return out


def _checked(
    gate: Gate, means: Array, covs: Array, other_means: Array, other_covs: Array
) -> tuple[Array, Array, Array, Array]:
    d, sides = gate.dof, []
    for mean, cov in ((means, covs), (other_means, other_covs)):
        mean, cov = np.asarray(mean, float), np.asarray(cov, float)
        if mean.ndim != 2 or mean.shape[1] != d or cov.shape != (len(mean), d, d):
            raise ParameterError(f"a gate of {d} dof wants (n, {d}) and (n, {d}, {d}), got {mean.shape}, {cov.shape}")
        if not np.isfinite(mean).all():
            raise ParameterError(f"a mean is not finite: row {int(np.argmin(np.isfinite(mean).all(1)))}")
        sides += [mean, cov]
    if len(sides[1]) and len(sides[3]):
        smallest = sides[1] + sides[3][np.argmin(np.trace(sides[3], axis1=1, axis2=2))]
        cholesky(smallest, "innovation covariance")
        cholesky(sides[3] + sides[1][np.argmin(np.trace(sides[1], axis1=1, axis2=2))], "innovation covariance")
    return sides[0], sides[1], sides[2], sides[3]


def _padded(mean: Array, cov: Array) -> tuple[Array, Array]:
    """One dimension as two, the second the same for all."""
    wide = np.zeros((len(mean), 2, 2))
    wide[:, 0, 0], wide[:, 1, 1] = cov[:, 0, 0], 1.0
    return np.concatenate([mean, np.zeros_like(mean)], axis=1), wide


def _screen(
    threshold: float, a: Array, A: Array, b: Array, B: Array, exact: tuple[Array, Array, Array, Array]
) -> BoolArray:
    """Pairs whose two-dimensional distance passes (r, c); those in doubt are decided by their `exact` Gaussians."""
    (a, A), (b, B) = _whitened((a, A), (b, B))
    left, right = _left(a, A, threshold), _right(b, B, threshold)
    doubt = 64.0 * np.finfo(float).eps * (np.abs(left) @ np.abs(right).max(1))  # rounding of each row's products
    harmless = doubt <= NEGLIGIBLE * threshold * (_det(A) + _det(B).min())  # det(A + B) >= det A + det B
    out = np.empty((len(a), len(b)), dtype=bool)
    rows = max(1, BLOCK_BYTES // (8 * len(b)))
    products = np.empty((rows, len(b)))
    for start in range(0, len(a), rows):
        part = slice(start, min(start + rows, len(a)))
        block = np.matmul(left[part], right, out=products[: part.stop - start])
        np.less_equal(block, 0.0, out=out[part])
        if not harmless[part].all():
            i, j = np.nonzero(np.abs(block) <= doubt[part, None])
            out[start + i, j] = _passes(threshold, exact, start + i, j)
    return out


def _det(cov: Array) -> Array:
    out: Array = cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2
    return out


def _whitened(one: tuple[Array, Array], two: tuple[Array, Array]) -> list[tuple[Array, Array]]:
    """Both sets in coordinates in which the mean covariance is the identity and the values are centred."""
    centre = 0.5 * (np.median(one[0], axis=0) + np.median(two[0], axis=0))
    lower = cholesky(one[1].mean(0) + two[1].mean(0))
    turn = np.linalg.solve(lower, np.eye(2))
    return [(forward_substitution(lower, mean - centre), turn @ cov @ turn.T) for mean, cov in (one, two)]


def _left(mean: Array, cov: Array, threshold: float) -> Array:
    """The twelve numbers of i (r, 12)."""
    x, y = mean.T
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    one = np.ones_like(x)
    alone = c * x * x - 2.0 * b * x * y + a * y * y - threshold * (a * c - b * b)
    with_x, with_y = -2.0 * (c * x - b * y), -2.0 * (a * y - b * x)
    with_a, with_b, with_c = y * y - threshold * c, -2.0 * (x * y - threshold * b), x * x - threshold * a
    return np.stack([alone, one, with_x, with_y, c, -2.0 * b, a, with_a, with_b, with_c, x, y], axis=1)


def _right(mean: Array, cov: Array, threshold: float) -> Array:
    """The twelve numbers of j (12, c), each for the one of i in the same place."""
    x, y = mean.T
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    one = np.ones_like(x)
    alone = c * x * x - 2.0 * b * x * y + a * y * y - threshold * (a * c - b * b)
    with_x, with_y = -2.0 * (c * x - b * y), -2.0 * (a * y - b * x)
    return np.stack([one, alone, x, y, x * x, x * y, y * y, a, b, c, with_x, with_y])


def _passes(threshold: float, exact: tuple[Array, Array, Array, Array], i: ArrayLike, j: ArrayLike) -> BoolArray:
    a, A, b, B = exact
    i, j = np.asarray(i), np.asarray(j)
    out = np.empty(len(i), dtype=bool)
    for start in range(0, len(i), EXACT_AT_ONCE):
        p, q = i[start : start + EXACT_AT_ONCE], j[start : start + EXACT_AT_ONCE]
        out[start : start + EXACT_AT_ONCE] = mahalanobis_sq(b[q] - a[p], A[p] + B[q]) <= threshold
    return out


def _many_dimensions(threshold: float, a: Array, A: Array, b: Array, B: Array) -> BoolArray:
    """Gate in two directions at a time, those first in which the sets spread most, then the survivors in all."""
    lower = cholesky(A.mean(0) + B.mean(0))
    spread = forward_substitution(lower, np.concatenate([a, b]))
    axes = np.linalg.eigh(np.cov(spread.T))[1][:, ::-1]
    turn = np.linalg.solve(lower.T, axes).T  # (d, d)
    out = np.ones((len(a), len(b)), dtype=bool)
    for k in range(0, len(turn) - 1, 2):
        two = turn[k : k + 2]
        small = (a @ two.T, two @ A @ two.T, b @ two.T, two @ B @ two.T)
        out &= _screen(threshold, *small, exact=small)
    rows = max(1, EXACT_AT_ONCE * 10 // len(b))
    for start in range(0, len(a), rows):
        i, j = np.nonzero(out[start : start + rows])
        out[start + i, j] = _passes(threshold, (a, A, b, B), start + i, j)
    return out
