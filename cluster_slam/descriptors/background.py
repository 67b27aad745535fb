"""How likely is a match by chance: the clusters that a plant has, as Gaussian clouds whose size varies.

Two clusters match by accident the more easily the smaller they are. The likelihood ratio of "one and the same" against
"two of those that there are" says so; the bare squared distance does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import lgamma

import numpy as np
from scipy.special import logsumexp

from cluster_slam.descriptors.alignment import FREE_TURN, rigid_fit
from cluster_slam.descriptors.members import centred, checked_points
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from tracking.gaussian import LOG_2PI

HERMITE_NODES = 15
LEAST_SHARE = 0.05  # of a cluster's inertia is taken to be real, however large the errors


@dataclass(frozen=True, slots=True)
class Background:
    """Members are drawn from N(centre, s^2 I) with log s normal; the centre may be anywhere."""

    median_scale: float  # of s, per axis, m
    log_spread: float  # standard deviation of log s

    def __post_init__(self) -> None:
        if not (self.median_scale > 0 and self.log_spread >= 0):
            raise InputError(f"a background needs a scale > 0 and a spread >= 0, got {self}")

    @classmethod
    def of_clusters(cls, clusters: Sequence[Array], sigma: float = 0.0) -> Background:
        """Fitted to clusters (n_i, 3), n_i >= 2, observed with errors `sigma`.

        Moments of log s, less what few members alone would scatter it.
        """
        from scipy.special import digamma, polygamma

        if not len(clusters):
            raise InputError("a background needs at least one cluster")
        half_dof = np.array([1.5 * (len(c) - 1) for c in clusters])
        seen = np.array([(centred(checked_points(c)) ** 2).sum() for c in clusters])
        inertia = np.maximum(seen - 2.0 * half_dof * sigma**2, LEAST_SHARE * seen)
        log_s = 0.5 * (np.log(inertia) - digamma(half_dof) - np.log(2.0))
        spread_sq = log_s.var() - 0.25 * polygamma(1, half_dof).mean()
        return cls(float(np.exp(log_s.mean())), float(np.sqrt(max(spread_sq, 0.0))))

    def log_density(self, points: Array, sigma: float = 0.0) -> Array:
        """Log density (...) of members (..., n, 3) observed with errors `sigma`, centre of density 1 per m^3."""
        offsets = centred(checked_points(points))
        var, log_weights = self._scales()
        inertia = (offsets * offsets).sum((-1, -2))[..., None]
        n = offsets.shape[-2]
        each = _log_normal(inertia, var + sigma**2, 3 * (n - 1)) - 1.5 * np.log(n)
        out: Array = logsumexp(each + log_weights, axis=-1)
        return out

    def log_likelihood_ratio(
        self, reference: Array, observed: Array, sigma_reference: float, sigma_observed: float
    ) -> Array:
        """Log ratio (...) of one cluster observed twice to two clusters, members matched by their order.

        Centres may be anywhere and orientations are uniform; of the n! ways to match the members the given one counts.

        Parameters
        ----------
        reference, observed
            (..., n, 3), each in its own frame, m.
        sigma_reference, sigma_observed
            Standard deviations of the members' errors along each axis, m.
        """
        a, b = centred(checked_points(reference)), centred(checked_points(observed))
        dof = 3 * (a.shape[-2] - 1)
        R = rigid_fit(a, b)[..., :3, :3]
        turned = a @ np.swapaxes(R, -1, -2)
        inertia_a, inertia_b = ((x * x).sum((-1, -2))[..., None] for x in (a, b))
        overlap = (turned * b).sum((-1, -2))[..., None]
        var, log_weights = self._scales()
        va, vb = var + sigma_reference**2, var + sigma_observed**2
        det = va * vb - var**2
        joint = -0.5 * (
            (vb * inertia_a + va * inertia_b - 2.0 * var * overlap) / det + dof * (np.log(det) + 2 * LOG_2PI)
        )
        turning = _turning(turned, b)[..., None, :, :] * (var / det)[:, None, None] + FREE_TURN * np.eye(3)
        rotation = 1.5 * LOG_2PI - 0.5 * np.linalg.slogdet(turning)[1] - np.log(8.0 * np.pi**2)
        same = logsumexp(joint + rotation + log_weights, axis=-1) - lgamma(a.shape[-2] + 1)
        apart = [
            logsumexp(_log_normal(x, v, dof) + log_weights, axis=-1) for x, v in ((inertia_a, va), (inertia_b, vb))
        ]
        out: Array = same - apart[0] - apart[1]
        return out

    def _scales(self) -> tuple[Array, Array]:
        """Variances s^2 (q,) and the logarithms of their weights: Gauss and Hermite over log s."""
        x, w = np.polynomial.hermite_e.hermegauss(HERMITE_NODES)
        return (self.median_scale * np.exp(self.log_spread * x)) ** 2, np.log(w / w.sum())


def _log_normal(inertia: Array, var: Array, dof: int) -> Array:
    out: Array = -0.5 * (inertia / var + dof * (np.log(var) + LOG_2PI))
    return out


def _turning(a: Array, b: Array) -> Array:
    """Second derivative (..., 3, 3) of -sum a.b by a rotation of a, at its best rotation; not below zero."""
    cross = np.swapaxes(a, -1, -2) @ b
    out = np.trace(cross, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - 0.5 * (cross + np.swapaxes(cross, -1, -2))
    values, axes = np.linalg.eigh(out)
    floored: Array = (axes * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2)
    return floored
