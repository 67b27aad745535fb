"""All sessions of a plant in one graph: where each base stood, where each cluster is and how it drifts.

Session by session a map only looks back. Here all of them are smoothed together: an observation of cluster j by session
s, with local centroid q and time t since the cluster was first seen, says

    T_s exp(xi_s) q = p_j + v_j t + noise,   v_j ~ N(0, rate^2 / 3 I)

with the first session's frame fixed. What all clusters drift in common stays with the prior, as in the map itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from cluster_slam.geometry import Array, se3_exp, skew, transform
from cluster_slam.records import IntArray

_UNIT = {3: gtsam.noiseModel.Unit.Create(3), 6: gtsam.noiseModel.Unit.Create(6)}


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Clusters as sessions saw them; m sightings, s sessions, c clusters."""

    session: IntArray  # (m,) row of the session; 0 makes the frame
    cluster: IntArray  # (m,) row of the cluster
    local: Array  # (m, 3) centroid in the session's own world, times the session's scale
    days: Array  # (m,) since the cluster was first seen
    sigma: Array  # (m,) m, one sigma an axis: measurement and random walk


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """What all sessions together say."""

    T_map_world: Array  # (s, 4, 4)
    T_covs: Array  # (s, 6, 6); zero for the first
    positions: Array  # (c, 3) when first seen
    velocities: Array  # (c, 3) m/day
    covs: Array  # (c, 6, 6) of position and velocity
    rms_before: float  # m, of residuals over their sigma
    rms_after: float


def smooth_sessions(
    sightings: Sightings, T_map_world: Array, rate: float, n_iterations: int = 6, huber: float = 3.0
) -> Smoothed:
    """Smooth all sessions of a plant together.

    Parameters
    ----------
    T_map_world
        (s, 4, 4) to begin with.
    rate
        m/day, RMS norm of the drift of a cluster.
    huber
        Residuals beyond so many sigmas count less: flowers that were lost or found move a centroid.
    """
    T, n = T_map_world.copy(), int(sightings.cluster.max()) + 1
    positions, velocities = _begin(sightings, T, n), np.zeros((n, 3))
    rms_before = -1.0
    graph = gtsam.GaussianFactorGraph()
    for _ in range(n_iterations):
        residual = _residuals(sightings, T, positions, velocities)
        size = np.linalg.norm(residual, axis=1) / sightings.sigma
        rms_before = float(np.sqrt((size**2).mean())) if rms_before < 0 else rms_before
        weight = np.sqrt(np.minimum(1.0, huber / np.maximum(size, 1e-9))) / sightings.sigma
        graph = _linear(sightings, T, velocities, residual, weight, rate)
        step = graph.optimize()
        for s in range(1, len(T)):
            T[s] = T[s] @ se3_exp(step.at(_pose(s)))
        for c in range(n):
            change = step.at(_cluster(c))
            positions[c] += change[:3]
            velocities[c] += change[3:]
    after = np.linalg.norm(_residuals(sightings, T, positions, velocities), axis=1) / sightings.sigma
    T_covs, covs = _covariances(graph, len(T), n)
    return Smoothed(T, T_covs, positions, velocities, covs, rms_before, float(np.sqrt((after**2).mean())))


def _pose(s: int) -> int:
    return int(gtsam.symbol("x", s))


def _cluster(c: int) -> int:
    return int(gtsam.symbol("l", c))


def _begin(sightings: Sightings, T: Array, n: int) -> Array:
    """Positions (n, 3) of the clusters as their earliest sighting has them."""
    out = np.zeros((n, 3))
    order = np.argsort(-sightings.days, kind="stable")
    out[sightings.cluster[order]] = transform(T[sightings.session[order]], sightings.local[order])
    return out


def _residuals(sightings: Sightings, T: Array, positions: Array, velocities: Array) -> Array:
    expected = positions[sightings.cluster] + sightings.days[:, None] * velocities[sightings.cluster]
    seen: Array = transform(T[sightings.session], sightings.local)
    return seen - expected


def _linear(
    sightings: Sightings, T: Array, velocities: Array, residual: Array, weight: Array, rate: float
) -> gtsam.GaussianFactorGraph:
    """The linearised graph; whitened rows."""
    graph = gtsam.GaussianFactorGraph()
    R = T[sightings.session, :3, :3]
    of_pose = np.concatenate([-R @ skew(sightings.local), R], axis=2) * weight[:, None, None]
    eye = np.eye(3)
    for k, (s, c) in enumerate(zip(sightings.session.tolist(), sightings.cluster.tolist(), strict=True)):
        of_cluster = -weight[k] * np.hstack([eye, sightings.days[k] * eye])
        b = -weight[k] * residual[k]
        if s == 0:
            graph.add(gtsam.JacobianFactor(_cluster(c), of_cluster, b, _UNIT[3]))
        else:
            graph.add(gtsam.JacobianFactor(_pose(s), of_pose[k], _cluster(c), of_cluster, b, _UNIT[3]))
    prior = np.diag([1e-3] * 3 + [np.sqrt(3.0) / rate] * 3)  # the position is free
    for c in range(len(velocities)):
        b = -prior @ np.concatenate([np.zeros(3), velocities[c]])
        graph.add(gtsam.JacobianFactor(_cluster(c), prior, b, _UNIT[6]))
    for s in range(1, len(T)):  # what a session does not share with the others to tell stays as it is: a turn, or all
        graph.add(gtsam.JacobianFactor(_pose(s), np.eye(6), np.zeros(6), _UNIT[6]))  # to a radian, and a metre
    return graph


def _covariances(graph: gtsam.GaussianFactorGraph, n_sessions: int, n_clusters: int) -> tuple[Array, Array]:
    """Marginal covariances of the poses (s, 6, 6) and of the clusters (c, 6, 6)."""
    keys = [_cluster(c) for c in range(n_clusters)] + [_pose(s) for s in range(1, n_sessions)]
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    information, _ = graph.hessian(ordering)
    joint = np.linalg.solve(information, np.eye(len(information)))
    blocks = [joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(keys))]
    poses = np.array([np.zeros((6, 6)), *blocks[n_clusters:]])
    return poses, np.array(blocks[:n_clusters])
