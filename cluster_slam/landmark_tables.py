"""From a smoothed session to the tables of a result: flowers, clusters with descriptors, drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.displacement import cluster_pairs
from cluster_slam.association.frames import Frames
from cluster_slam.descriptors import inertia_and_mean_distance, unscented_moments
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, Clusters, Drift, Flowers, IntArray, State


@dataclass(frozen=True, slots=True, eq=False)
class RestMap:
    """Flowers at rest: places (l, 3) with their joint covariance (3 l, 3 l), cluster (l,), and who was seen where."""

    places: Array
    joint_cov: Array
    cluster: IntArray
    landmark: IntArray  # (m,) of each sorted observation, -1 clutter

    def block(self, members: IntArray) -> Array:
        """Joint covariance (3 k, 3 k) of k members."""
        index = (3 * members[:, None] + np.arange(3)).ravel()
        block: Array = self.joint_cov[np.ix_(index, index)]
        return block


def flower_table(rest: RestMap, frames: Frames) -> Flowers:
    """The flowers, with when each was seen."""
    n = len(rest.places)
    first, last, count = _seen(frames, rest.landmark, n)
    index = 3 * np.arange(n)[:, None] + np.arange(3)
    return Flowers(
        ids=np.arange(n),
        cluster_ids=rest.cluster.copy(),
        positions=rest.places,
        covs=rest.joint_cov[index[:, :, None], index[:, None, :]],
        first_seen=first,
        last_seen=last,
        n_observations=count,
    )


def cluster_table(rest: RestMap, frames: Frames, confirmed: BoolArray) -> Clusters:
    """The clusters: unweighted centroids, descriptors from the joint covariance of the members.

    ``confirmed`` (c,) says which clusters stand; the others are tentative.
    """
    n = int(rest.cluster.max(initial=-1)) + 1
    used = rest.landmark >= 0
    owner = np.where(used, rest.cluster[rest.landmark], -1) if n else np.full(len(frames), -1)
    first, last, count = _seen(frames, owner, n)
    positions, covs = np.zeros((n, 3)), np.zeros((n, 3, 3))
    descriptors, descriptor_covs = np.zeros((n, 2)), np.zeros((n, 2, 2))
    n_flowers = np.bincount(rest.cluster, minlength=n)
    for j in range(n):
        members = np.flatnonzero(rest.cluster == j)
        P = rest.block(members)
        k = len(members)
        positions[j] = rest.places[members].mean(axis=0)
        covs[j] = P.reshape(k, 3, k, 3).sum(axis=(0, 2)) / k**2
        if k >= 2:
            descriptors[j] = inertia_and_mean_distance(rest.places[members])
            _, descriptor_covs[j] = unscented_moments(rest.places[members], P)
    states: tuple[State, ...] = tuple("confirmed" if c else "tentative" for c in confirmed)
    return Clusters(
        ids=np.arange(n),
        positions=positions,
        covs=covs,
        n_flowers=n_flowers,
        descriptors=descriptors,
        descriptor_covs=descriptor_covs,
        first_seen=first,
        last_seen=last,
        n_observations=count,
        states=states,
    )


def drift_table(rest: RestMap, frames: Frames, clusters: Clusters, d: Array, prior_var: Array, cov: Array) -> Drift:
    """Where each cluster's centroid was in each frame that saw it.

    ``d`` (p, 3) displacement of each cluster-in-frame pair, ``prior_var`` (p,) how far it may be from rest,
    ``cov`` (p, 3, 3) what the frame's own observations say of it. The error of the rest position and of the
    displacement cancel as far as the frame itself fixes the position: gain K = prior (prior + cov)^-1.
    """
    _, frame, cluster = cluster_pairs(frames, rest.landmark, rest.cluster)
    prior = prior_var[:, None, None] * np.eye(3)
    K = np.swapaxes(np.linalg.solve(prior + cov, prior), 1, 2)
    rest_of = np.eye(3) - K
    total = rest_of @ clusters.covs[cluster] @ np.swapaxes(rest_of, 1, 2) + K @ cov
    total = 0.5 * (total + np.swapaxes(total, 1, 2))
    return Drift(frame=frame, cluster_ids=cluster, positions=clusters.positions[cluster] + d, covs=total)


def _seen(frames: Frames, label: IntArray, n: int) -> tuple[Array, Array, IntArray]:
    """First and last stamp (n,) and number of observations (n,) of each label."""
    used = label >= 0
    stamp = frames.stamps[frames.frame[used]]
    first, last = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(first, label[used], stamp)
    np.maximum.at(last, label[used], stamp)
    return first, last, np.bincount(label[used], minlength=n)
