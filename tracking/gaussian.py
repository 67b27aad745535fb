"""Gaussians as (mean, covariance): checks, whitening, fusion. All functions take stacks that broadcast."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking.errors import CovarianceError

Array = NDArray[np.float64]
LOG_2PI = float(np.log(2.0 * np.pi))
ASYMMETRY = 1e-8  # largest |C - C'| that counts as rounding, relative to the largest entry


def symmetrise(cov: Array) -> Array:
    """(C + C') / 2 of matrices (..., d, d)."""
    out: Array = 0.5 * (cov + np.swapaxes(cov, -1, -2))
    return out


def ensure_positive_definite(cov: Array, name: str = "covariance") -> Array:
    """The covariances (..., d, d) as symmetric float64, or an error that says what is wrong with which of them.

    Raises
    ------
    CovarianceError
        Not square, not finite, not symmetric (beyond rounding), or not positive definite: the message prints the
        smallest eigenvalue.
    """
    clean = _finite_symmetric(cov, name)
    cholesky(clean, name)
    return clean


def ensure_positive_semidefinite(cov: Array, name: str = "covariance") -> Array:
    """As `ensure_positive_definite`, but eigenvalues of zero (to rounding) are allowed."""
    clean = _finite_symmetric(cov, name)
    eigenvalues = np.linalg.eigvalsh(clean)
    floor = -64 * np.finfo(float).eps * clean.shape[-1] * np.abs(eigenvalues).max(-1, initial=0.0)
    if np.any(eigenvalues[..., 0] < floor):
        raise CovarianceError(_worst(clean, name))
    return clean


def cholesky(cov: Array, name: str = "covariance") -> Array:
    """Lower Cholesky factors (..., d, d); only the lower triangle is read.

    Raises
    ------
    CovarianceError
        A matrix is not positive definite: the message prints the smallest eigenvalue.
    """
    try:
        lower = np.linalg.cholesky(np.asarray(cov, dtype=np.float64))
    except np.linalg.LinAlgError:
        raise CovarianceError(_worst(np.asarray(cov), name)) from None
    return np.asarray(lower, dtype=np.float64)


def symmetric_root(cov: Array, name: str = "covariance") -> Array:
    """Symmetric square roots (..., d, d) of covariances that may be singular.

    Raises
    ------
    CovarianceError
        A matrix is not positive semidefinite.
    """
    values, axes = np.linalg.eigh(ensure_positive_semidefinite(cov, name))
    out: Array = (axes * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(axes, -1, -2)
    return out


def forward_substitution(lower: Array, vectors: Array) -> Array:
    """L^-1 v for lower triangular factors (..., d, d) and vectors (..., d)."""
    shape = np.broadcast_shapes(lower.shape[:-1], vectors.shape)
    out = np.empty(shape)
    for i in range(shape[-1]):
        known = (lower[..., i, :i] * out[..., :i]).sum(-1)
        out[..., i] = (vectors[..., i] - known) / lower[..., i, i]
    return out


def whiten(vectors: Array, cov: Array) -> Array:
    """L^-1 v (..., d) with C = L L': zero-mean vectors of covariance C become standard normal."""
    return forward_substitution(cholesky(cov), vectors)


def log_det(cov: Array) -> Array:
    """log |C| (...) of positive definite matrices (..., d, d)."""
    out: Array = 2.0 * np.log(np.diagonal(cholesky(cov), axis1=-2, axis2=-1)).sum(-1)
    return out


def fuse(mean_a: Array, cov_a: Array, mean_b: Array, cov_b: Array) -> tuple[Array, Array]:
    """The normalised product of two Gaussians: two independent estimates of one quantity become one.

    Gain form, with the covariance in Joseph's form, so that it stays positive definite when one estimate is far better
    than the other (Bar-Shalom, Li, Kirubarajan 2001, eq. 5.2.3-18).

    Returns
    -------
    mean (..., d), cov (..., d, d)
    """
    total = symmetrise(cov_a + cov_b)
    cholesky(total, "sum of the covariances")
    gain = np.swapaxes(np.linalg.solve(total, np.broadcast_to(cov_a, total.shape)), -1, -2)
    mean = mean_a + (gain @ (mean_b - mean_a)[..., None])[..., 0]
    rest = np.eye(total.shape[-1]) - gain
    cov = rest @ cov_a @ np.swapaxes(rest, -1, -2) + gain @ cov_b @ np.swapaxes(gain, -1, -2)
    return mean, symmetrise(cov)


def fuse_many(means: Array, covs: Array) -> tuple[Array, Array]:
    """The normalised product of n Gaussians (..., n, d), (..., n, d, d), in information form.

    Returns
    -------
    mean (..., d), cov (..., d, d)
    """
    identity = np.broadcast_to(np.eye(covs.shape[-1]), covs.shape)
    cholesky(covs)
    informations = np.asarray(np.linalg.solve(covs, identity), np.float64)
    cov = np.asarray(np.linalg.solve(symmetrise(informations.sum(-3)), identity[..., 0, :, :]), np.float64)
    weighted = (informations @ means[..., None]).sum(-3)
    return (cov @ weighted)[..., 0], symmetrise(cov)


def _finite_symmetric(cov: Array, name: str) -> Array:
    cov = np.asarray(cov, dtype=float)
    if cov.ndim < 2 or cov.shape[-1] != cov.shape[-2]:
        raise CovarianceError(f"{name}: expected square matrices, got shape {cov.shape}")
    if not np.isfinite(cov).all():
        raise CovarianceError(f"{name}{_where(~np.isfinite(cov).all((-1, -2)))}: not finite")
    asymmetry = np.abs(cov - np.swapaxes(cov, -1, -2)).max((-1, -2), initial=0.0)
    bad = np.asarray(asymmetry > ASYMMETRY * np.abs(cov).max((-1, -2), initial=0.0))
    if bad.any():
        raise CovarianceError(f"{name}{_where(bad)}: not symmetric, |C - C'| reaches {asymmetry.max():.3g}")
    return symmetrise(cov)


def _worst(cov: Array, name: str) -> str:
    """What to say of the worst of some covariances."""
    finite = np.asarray(np.isfinite(cov).all((-1, -2)))
    if not finite.all():
        return f"{name}{_where(~finite)}: not finite"
    smallest = np.asarray(np.linalg.eigvalsh(symmetrise(cov))[..., 0])
    where = _where(smallest == smallest.min())
    return f"{name}{where}: not positive definite, smallest eigenvalue {smallest.min():.6g}"


def _where(bad: NDArray[np.bool_] | np.bool_) -> str:
    """' [i, j]' of the first marked entry of a stack; nothing for a single matrix."""
    return "" if bad.ndim == 0 else f" {np.argwhere(bad)[0].tolist()}"
