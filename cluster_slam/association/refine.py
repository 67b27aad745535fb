"""Mending the set of landmarks once all is smoothed: ghosts merged, the unsupported dropped, the overlooked found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from cluster_slam.association.displacement import presence_of
from cluster_slam.association.frames import Frames
from cluster_slam.association.landmarks import merge_pieces
from cluster_slam.association.tracklets import build_tracklets
from cluster_slam.config import TrackletConfig
from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.records import IntArray


def merge_ghosts(
    places: Array, landmark: IntArray, frames: Frames, radius: float, shared: float = 0.15
) -> tuple[IntArray, list[tuple[int, int]]]:
    """Landmark of each observation with duplicates merged, and the merged pairs (from, to).

    Two landmarks closer than ``radius`` that are hardly ever seen in one frame are one flower: the one with fewer
    observations goes.
    """
    n = len(places)
    presence = presence_of(frames.frame, landmark, n, frames.n_frames)
    count = np.asarray(presence.sum(axis=1)).ravel()
    target = np.arange(n)
    merged = []
    for a, b in sorted(cKDTree(places).query_pairs(radius)) if n else []:
        both = presence[a].multiply(presence[b]).sum()
        if both < shared * min(count[a], count[b]) and target[a] == a and target[b] == b:
            keep, go = (a, b) if count[a] >= count[b] else (b, a)
            target[go] = keep
            merged.append((int(go), int(keep)))
    return np.where(landmark >= 0, target[landmark], -1), merged


def supported(landmark: IntArray, n: int, minimum: int) -> Array:
    """Which landmarks (n,) have at least ``minimum`` observations."""
    enough: Array = np.bincount(landmark[landmark >= 0], minlength=n) >= minimum
    return enough


def compact(keep: Array, landmark: IntArray) -> IntArray:
    """Labels of the kept landmarks, numbered anew; the others become -1."""
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    return np.where(landmark >= 0, number[landmark], -1)


def find_overlooked(
    frames: Frames,
    T: Array,
    cov_pose: Array,
    var: Array,
    landmark: IntArray,
    places: Array,
    displacement: Array,
    cluster: IntArray,
    radius: float,
    minimum: int,
    config: TrackletConfig,
) -> Array:
    """Places (k, 3) of flowers that no landmark stands for yet, among the observations left over.

    Each left-over point is moved back by the displacement (n, c, 3) of the cluster next to it, in its own frame: a
    flower that was only seen while its cluster swayed stands still after that.
    """
    left = np.flatnonzero(landmark < 0)
    if len(left) < minimum:
        return np.empty((0, 3))
    world = transform(T[frames.frame[left]], frames.points[left])
    if len(places):
        nearest = cluster[cKDTree(places).query(world)[1]]
        world = world - displacement[frames.frame[left], nearest]
    points = transform(inverse(T)[frames.frame[left]], world)
    rest = Frames(
        order=left,
        starts=np.searchsorted(frames.frame[left], np.arange(frames.n_frames + 1)),
        frame=frames.frame[left],
        points=points,
        covs=frames.covs[left],
        stamps=frames.stamps,
    )
    pieces = build_tracklets(rest, T, cov_pose, replace(config, min_age=10**9))
    shortest = max(2, minimum // 2)
    label, found = merge_pieces(world, var[left], pieces.labels, rest.frame, rest.n_frames, radius, shortest)
    return found[np.bincount(label[label >= 0], minlength=len(found)) >= minimum]
