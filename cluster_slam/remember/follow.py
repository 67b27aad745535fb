"""Clusters followed to where a session saw them: drift and growth learned, flowers moved, presence weighed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.fit import factor_posterior
from cluster_slam.constellation.growth import DAY_S, UNSTEADY, at, gaps, unsteady
from cluster_slam.constellation.identify import Identities
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray, PlantMap
from cluster_slam.remember.tables import CLUSTER, FLOWER, Aligned
from tracking.presence import after_group_miss, after_miss, persisted

PRIOR_CLUSTERS = 4.0  # the priors of drift and walk count as so many clusters
N_ROUNDS = 40  # of expectation maximisation


@dataclass(frozen=True, slots=True, eq=False)
class _Shift:
    """A cluster that was seen again, k of its flowers, and how far they are from where they were expected."""

    cluster: int  # row of the plant
    members: IntArray  # rows of all its flowers
    found: IntArray  # (k,) rows of those that were seen
    theirs: IntArray  # (k,) rows of the session's flowers
    residual: Array  # (k, 3)
    weight: Array  # (k,)
    mean: Array  # (3,)
    cov: Array  # (3, 3) of the mean, without what the flowers share


class Follower:
    """The plant's tables while one session is put in."""

    def __init__(
        self,
        plant: PlantMap,
        moved: PlantMap,
        where: Aligned,
        who: Identities,
        config: MapConfig,
        now: float,
    ) -> None:
        self.plant, self.moved, self.where, self.config, self.now = plant, moved, where, config, now
        self.values = {name: np.array(getattr(plant, name)) for name in (*CLUSTER, *FLOWER)}
        self.dt = gaps(plant, now)
        self.row = plant.flower_rows
        self.partner = np.full(len(plant.flower_ids), -1)  # the session's flower of each of the plant's
        found = np.flatnonzero(who.flower >= 0)
        self.partner[who.flower[found]] = found
        self.seen = np.zeros(len(plant.cluster_ids), dtype=bool)
        self.seen[who.cluster[who.cluster >= 0]] = True
        self.missed = np.zeros(len(plant.cluster_ids), dtype=bool)
        self.walk_rate = plant.walk_rate
        self.measured: dict[int, tuple[float, float]] = {}  # growth rate of a cluster, and its variance

    def follow_clusters(self) -> None:
        """Each cluster of which flowers were seen again is moved to where they are, and its drift is learned."""
        again = np.unique(self.row[self.partner >= 0])
        for c in np.setdiff1d(np.flatnonzero(self.seen), again).tolist():
            self._carry(c)
        self.seen[again] = True
        self.walk_rate = self._learn_walk(again, [self._shift(c) for c in again.tolist()])
        self.moved = at(replace(self.plant, walk_rate=self.walk_rate), self.now, self.config.growth)
        for c in again.tolist():
            self._follow(self._shift(c))

    def _carry(self, c: int) -> None:
        """A cluster that was seen again with other flowers only stands where it was expected."""
        v, moved, members = self.values, self.moved, np.flatnonzero(self.row == c)
        for name in ("clusters", "cluster_covs", "velocities", "velocity_covs", "position_velocity_covs"):
            v[name][c] = getattr(moved, name)[c]
        v["flowers"][members], v["flower_covs"][members] = moved.flowers[members], moved.flower_covs[members]
        v["cluster_time"][c] = v["cluster_last_seen"][c] = v["cluster_last_looked_at"][c] = self.now

    def _shift(self, c: int) -> _Shift:
        """How far a cluster's flowers are from where they were expected."""
        members = np.flatnonzero(self.row == c)
        found = members[self.partner[members] >= 0]
        theirs = self.partner[found]
        residual = self.where.flowers[theirs] - self.moved.flowers[found]
        own = self.moved.flower_covs[found] + self.where.covs[theirs]
        weight = 1.0 / (np.trace(own, axis1=1, axis2=2) / 3.0)
        R = np.einsum("k,kij->ij", weight**2, own) / weight.sum() ** 2
        return _Shift(c, members, found, theirs, residual, weight, weight @ residual / weight.sum(), R)

    def _learn_walk(self, rows: IntArray, shifts: list[_Shift]) -> float:
        """Random walk of the clusters, m/sqrt(day): what steady drift does not explain (expectation maximisation)."""
        growth, before = self.config.growth, self.plant.walk_rate
        used = np.flatnonzero(np.abs(self.dt[rows]) > 0.25 * DAY_S)
        if len(used) < 4 or growth.walk_m_per_sqrt_day == 0.0:
            return before
        means = np.array([shifts[k].mean for k in used.tolist()])
        lost = len(used) / (len(used) - 2.0)  # 6 of 3 n components went into the alignment
        squared = lost * ((means - np.median(means, axis=0)) ** 2).sum(1) / 3.0
        noise = np.array([np.trace(shifts[k].cov) / 3.0 for k in used.tolist()])
        total = np.trace(self.moved.cluster_covs[rows[used]], axis1=1, axis2=2) / 3.0 + noise
        expected = unsteady(self.plant, self.dt[rows[used]], growth)
        prior = float(np.clip((before / growth.walk_m_per_sqrt_day) ** 2, *UNSTEADY))
        rest, factor = np.maximum(total - prior * expected, noise), prior
        for _ in range(N_ROUNDS):
            own = factor * expected
            share = own / (rest + own)
            walked = (share**2 * np.minimum(squared, 9.0 * total) + own * (1.0 - share)) / expected
            factor = (PRIOR_CLUSTERS * prior + float(walked.sum())) / (PRIOR_CLUSTERS + len(used))
        return float(np.sqrt(np.clip(factor, *UNSTEADY))) * growth.walk_m_per_sqrt_day

    def _follow(self, shift: _Shift) -> None:
        v, c = self.values, shift.cluster
        offset = self._move(c, shift.mean, shift.cov)
        v["cluster_time"][c] = v["cluster_last_seen"][c] = v["cluster_last_looked_at"][c] = self.now
        self._measure_growth(c, shift.found, shift.theirs, shift.weight)
        self._move_flowers(shift, offset)

    def _move(self, c: int, mean: Array, R: Array) -> Array:
        """Kalman update of a cluster's place and drift with how far it was from where it was expected: the shift."""
        v, moved = self.values, self.moved
        P = moved.cluster_covs[c]
        size, noise = (np.array([np.trace(m) / 3.0]) for m in (P, R))
        weight, factors = factor_posterior(np.array([mean @ mean / 3.0]), 3.0, size, noise)
        factor = float(np.exp(weight @ np.log(factors)))  # what this cluster says of how unsure its drift was
        P, C, V = (factor * m for m in (P, moved.position_velocity_covs[c], moved.velocity_covs[c]))
        S = P + R
        K, Kv = np.linalg.solve(S, P).T, np.linalg.solve(S, C).T
        v["cluster_covs"][c] = _symmetric(P - K @ P)
        v["velocities"][c] = moved.velocities[c] + Kv @ mean
        v["velocity_covs"][c] = _symmetric(V - Kv @ C)
        v["position_velocity_covs"][c] = C - K @ C
        shift: Array = K @ mean
        return shift

    def _move_flowers(self, shift: _Shift, offset: Array) -> None:
        """All flowers go with their cluster; those that were seen also to where they were seen in it."""
        v, moved, members, found = self.values, self.moved, shift.members, shift.found
        v["flowers"][members] = moved.flowers[members] + offset
        v["flower_covs"][members] = moved.flower_covs[members]
        F, Q = moved.flower_covs[found], self.where.covs[shift.theirs]
        gain = np.swapaxes(np.linalg.solve(F + Q, F), 1, 2)
        v["flowers"][found] += (gain @ (shift.residual - offset)[..., None])[..., 0]
        v["flower_covs"][found] = _symmetric(F - gain @ F)

    def learn_growth(self) -> None:
        """Growth rates from what was measured: first what all clusters have in common, then each cluster's own.

        Two levels of Gaussians: rate of a cluster = common rate + its own part, of ``size_spread`` times its sigma.
        """
        v, growth = self.values, self.config.growth
        if not self.measured:
            return
        rows = np.array(sorted(self.measured))
        rate, var = np.array([self.measured[c] for c in rows.tolist()]).T
        own = (growth.size_spread * growth.size_sigma_per_day / DAY_S) ** 2
        prior = np.maximum(v["growth_vars"][rows], own)
        shift = rate - v["growth_rates"][rows]
        common_prior = float(np.maximum(np.median(prior) - own, 1e-2 * own))
        weight = 1.0 / (own + var)
        common = float(weight @ shift) / (float(weight.sum()) + 1.0 / common_prior)
        common_var = 1.0 / (float(weight.sum()) + 1.0 / common_prior)
        v["growth_rates"] = v["growth_rates"] + common
        v["growth_vars"] = np.minimum(v["growth_vars"], own + common_var)
        gain = own / (own + var)
        v["growth_rates"][rows] += gain * (shift - common)
        v["growth_vars"][rows] = (1.0 - gain) * own + common_var

    def learn_drift(self) -> float:
        """RMS norm of the clusters' drift, m/day: one step of expectation maximisation with a weak prior.

        Of 3 n components 6 went into the alignment: two clusters less tell what drift there is.
        """
        v, prior = self.values, self.plant.drift_rate
        rows = np.flatnonzero(self.seen & (np.abs(self.dt) > 0.25 * DAY_S))
        if len(rows) < 4:
            return prior
        speed_sq = (v["velocities"][rows] ** 2).sum(1) + np.trace(v["velocity_covs"][rows], axis1=1, axis2=2)
        total = PRIOR_CLUSTERS * prior**2 + DAY_S**2 * float(speed_sq.sum())
        return float(np.sqrt(total / (PRIOR_CLUSTERS + len(rows) - 2.0)))

    def _measure_growth(self, c: int, found: IntArray, theirs: IntArray, weight: Array) -> None:
        """How fast a cluster's lengths grew, from the spread of the flowers that were seen again: rate and variance."""
        dt = self.dt[c]
        if len(found) < 3 or dt <= 0:
            return
        a, b = self.where.flowers[theirs], self.moved.flowers[found]
        a, b = a - np.average(a, axis=0, weights=weight), b - np.average(b, axis=0, weights=weight)
        size = float(weight @ (b * b).sum(1))
        ratio = max(float(weight @ (a * b).sum(1)) / size, 0.1)
        var = 1.0 / size / dt**2  # of the rate that the ratio tells
        self.measured[c] = self.moved.growth_rates[c] + np.log(ratio) / dt, var

    def look(self, looked: BoolArray) -> None:
        """Presence of what was seen, and of what was looked at and not seen."""
        v, options, growth = self.values, self.config.presence, self.config.growth
        since = np.nan_to_num((self.now - self.plant.flower_last_looked_at) / DAY_S)
        prior = persisted(v["flower_presence"], growth.lost_per_day, since)
        detection = self.config.match.seen_share * (1.0 - options.hidden_share)
        seen = self.partner >= 0
        for c in range(len(self.plant.cluster_ids)):
            members = np.flatnonzero(self.row == c)
            if self.seen[c]:
                rest = members[~seen[members]]
                v["flower_presence"][rest] = after_miss(prior[rest], detection)
            elif len(members) and looked[members].mean() > 0.5:
                self.missed[c] = True
                v["flower_presence"][members] = after_group_miss(
                    prior[members], detection, options.cluster_hidden_share
                )
                v["cluster_last_looked_at"][c] = self.now
            else:
                continue
            v["flower_last_looked_at"][members] = self.now
        v["flower_presence"][seen] = 1.0
        v["flower_last_seen"][seen] = self.now

    def result(self) -> PlantMap:
        """The plant with the tables as they stand."""
        values: dict[str, Any] = self.values
        return replace(self.plant, **values)


def _symmetric(m: Array) -> Array:
    out: Array = 0.5 * (m + np.swapaxes(m, -1, -2))
    return out
