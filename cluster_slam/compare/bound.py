"""What no descriptor can beat: the likelihood ratio under the very distribution that the clusters are drawn from.

With true positions C of density p0, observed as X and, turned and moved, as Y with errors s, the ratio of "one cluster
twice" to "two clusters" is, summed over all ways to match the members and integrated over the pose,

    sum N(X - Y'; 2 s^2) E[p0(C) | C ~ N((X + Y') / 2, s^2 / 2)]
    / (E[p0(C) | C ~ N(X, s^2)] E[p0(C) | C ~ N(Y, s^2)]),

Y' being Y brought back. By Neyman and Pearson it has the least false match rate of all statistics at every recall. The
expectations are Monte Carlo sums, the rotation is Laplace's integral, so that it is trusted where errors are small
against the clusters.
"""

from __future__ import annotations

from math import lgamma

import numpy as np
from scipy.special import logsumexp

from cluster_slam.compare.contenders import FAR
from cluster_slam.compare.population import Pairs, Population
from cluster_slam.descriptors import match_geometries
from cluster_slam.descriptors.alignment import rigid_fit
from cluster_slam.descriptors.search import search_maps
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from tracking.gating import chi2_threshold

N_DRAWS = 400
N_RADII = 200
PAIRS_AT_ONCE = 200
TINY = 1e-300


class TrueRatio:
    """The likelihood ratio for clusters of n flowers of a population, all observed with errors sigma."""

    def __init__(self, population: Population, n_flowers: int, sigma: float, *, rng: np.random.Generator) -> None:
        self.population, self.n, self.sigma = population, n_flowers, sigma
        self.reach = population.radius_m[1]
        self.radii, self.density = self._densities(rng=rng)
        self.errors = rng.standard_normal((N_DRAWS, n_flowers, 3))
        direction = rng.standard_normal((N_DRAWS, 3))
        self.r = self.reach * rng.random(N_DRAWS)
        self.centres = direction / np.linalg.norm(direction, axis=1, keepdims=True) * self.r[:, None]

    def __call__(self, pairs: Pairs, i: IntArray, j: IntArray) -> Array:
        """Log ratios (q,) of references i with observations j."""
        a, b = pairs.reference[i], pairs.observed[j]
        log_a, log_b = self.log_mean(pairs.reference, self.sigma)[i], self.log_mean(pairs.observed, self.sigma)[j]
        log_sum, middle = self._matched(a, b)
        out = np.full(len(i), -np.inf)
        found = np.isfinite(log_sum)
        joint = self.log_mean(middle[found], self.sigma / np.sqrt(2.0))
        out[found] = log_sum[found] + joint - log_a[found] - log_b[found]
        return out

    def log_mean(self, points: Array, sigma: float) -> Array:
        """log E[p0(C)] (p,) for C ~ N(points, sigma^2), centre of density 1 per m^3."""
        parts = [self._log_mean(points[k : k + PAIRS_AT_ONCE], sigma) for k in range(0, len(points), PAIRS_AT_ONCE)]
        return np.concatenate([np.zeros(0), *parts])

    def _log_mean(self, points: Array, sigma: float) -> Array:
        drawn = points[:, None] - points.mean(1)[:, None, None] + sigma * self.errors
        farthest = np.linalg.norm(drawn - self.centres[:, None], axis=-1).max(-1)
        value = np.interp(farthest, self.radii, self.density, right=0.0)
        weight = 4.0 * np.pi * self.r**2 * self.reach  # the ball's centre is drawn with density 1 / (4 pi r^2 reach)
        out: Array = np.log((value * weight * self.population.is_spaced(drawn)).mean(-1) + TINY)
        return out

    def _densities(self, *, rng: np.random.Generator) -> tuple[Array, Array]:
        """Density of the flowers integrated over ball radii above d, as a function of d."""
        low, high = self.population.radius_m
        radii = np.linspace(low, high, N_RADII)
        unit = Population((1.0, 1.0), 0.0).draw(self.n, 2000, rng=rng)
        share = np.array([self.population.is_spaced(r * unit).mean() for r in radii])
        each = (4.0 / 3.0 * np.pi * radii**3) ** -self.n / np.maximum(share, 1e-4) / (high - low)
        steps = 0.5 * (each[1:] + each[:-1]) * np.diff(radii)
        above = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
        return np.append(0.0, radii), np.append(above[0], above)

    def _matched(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Log of the sum over maps (q,), and the shapes halfway between for the best of them."""
        limit, var = chi2_threshold(max(3 * self.n - 6, 1), FAR), 2.0 * self.sigma**2
        match = match_geometries(a, b, np.sqrt(var), limit)
        partners = np.take_along_axis(b, match.observed[..., None], axis=1)
        T = rigid_fit(partners, a)
        back = partners @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        others = np.full(len(a), -np.inf)
        for start in range(0, len(a), PAIRS_AT_ONCE):
            part = slice(start, start + PAIRS_AT_ONCE)
            n = len(a[part])
            maps = search_maps(a[part], b[part], np.full(n, var), np.full(n, limit))
            for pair in np.unique(maps.pair):
                costs = maps.bound[maps.pair == pair]
                others[start + pair] = logsumexp(-0.5 * (costs - costs.min()))
        return match.log_likelihood + others - lgamma(self.n + 1), 0.5 * (a + back)
