"""How likely is a shape by chance: the clusters that a plant has, as a Gaussian cloud whose size varies.

Two clusters match by accident the more easily the smaller they are. The likelihood ratio of a match against this
background says so; the bare squared distance does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from cluster_slam.descriptors.members import centred, checked_points
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from tracking.gaussian import LOG_2PI

HERMITE_NODES = 15


@dataclass(frozen=True, slots=True)
class Background:
    """Members are drawn from N(centre, s^2 I) with log s normal; the centre may be anywhere."""

    median_scale: float  # of s, per axis, m
    log_spread: float  # standard deviation of log s

    def __post_init__(self) -> None:
        if not (self.median_scale > 0 and self.log_spread >= 0):
            raise InputError(f"a background needs a scale > 0 and a spread >= 0, got {self}")

    @classmethod
    def of_clusters(cls, clusters: list[Array]) -> Background:
        """Fitted to clusters (n_i, 3), n_i >= 2: moments of log s, less what few members alone would scatter it."""
        from scipy.special import digamma, polygamma

        inertia = np.array([(centred(checked_points(c)) ** 2).sum() for c in clusters])
        half_dof = np.array([1.5 * (len(c) - 1) for c in clusters])
        log_s = 0.5 * (np.log(inertia) - digamma(half_dof) - np.log(2.0))
        spread_sq = log_s.var() - 0.25 * polygamma(1, half_dof).mean()
        return cls(float(np.exp(log_s.mean())), float(np.sqrt(max(spread_sq, 0.0))))

    def log_density(self, points: Array, sigma: float = 0.0) -> Array:
        """Log density (...) of members (..., n, 3) observed with errors `sigma`, centre of density 1 per m^3."""
        x, w = np.polynomial.hermite_e.hermegauss(HERMITE_NODES)
        var = (self.median_scale * np.exp(self.log_spread * x)) ** 2 + sigma**2
        offsets = centred(checked_points(points))
        n = offsets.shape[-2]
        inertia = (offsets * offsets).sum((-1, -2))[..., None]
        each = -0.5 * (inertia / var + 3 * (n - 1) * (np.log(var) + LOG_2PI) + 3 * np.log(n))
        out: Array = logsumexp(each + np.log(w / w.sum()), axis=-1)
        return out
