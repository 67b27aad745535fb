"""Mending the set of landmarks once all is smoothed: ghosts merged, the unsupported dropped, the overlooked found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from cluster_slam.association.displacement import presence_of
from cluster_slam.association.frames import Frames, field_of_view
from cluster_slam.association.landmarks import merge_pieces
from cluster_slam.association.tracklets import build_tracklets
from cluster_slam.config import TrackletConfig
from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.records import BoolArray, IntArray


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
    return np.append(target, -1)[landmark], merged


def supported(
    frames: Frames, T: Array, places: Array, landmark: IntArray, minimum: int, least_share: float = 0.12
) -> BoolArray:
    """Which landmarks (l,) are believed: often enough seen at all, and in enough of the frames that looked at them.

    A frame looked at a place if it was in the field of view and one of the landmarks next to it was seen (so nothing
    stood before it). What is seen in less than ``least_share`` of those, compared with the others, is none: the place
    of a flower during a shake, a false detection that came twice.
    """
    count = np.bincount(landmark[landmark >= 0], minlength=len(places)).astype(float)
    if not count.any():
        return np.zeros(len(places), dtype=bool)
    share = count / np.maximum(np.maximum(frames_that_looked(frames, T, places, landmark), count), 1.0)
    order = np.argsort(share)
    usual = share[order][np.searchsorted(np.cumsum(count[order]), 0.5 * count.sum())]
    believed: BoolArray = (count >= minimum) & (share >= least_share * usual)
    return believed


def frames_that_looked(frames: Frames, T: Array, places: Array, landmark: IntArray, n_neighbours: int = 3) -> Array:
    """Number of frames (l,) that had each place (l, 3) in view and saw one of the landmarks next to it."""
    low, high = field_of_view(frames)
    n, size = frames.n_frames, len(places)
    seen = np.zeros((n, size), dtype=bool)
    used = landmark >= 0
    seen[frames.frame[used], landmark[used]] = True
    neighbours = cKDTree(places).query(places, k=min(n_neighbours + 1, size))[1].reshape(size, -1)
    total = np.zeros(size)
    for chunk in np.array_split(np.arange(n), 1 + n // 500):
        R, t = T[chunk, :3, :3], T[chunk, :3, 3]
        p = np.einsum("nba,nlb->nla", R, places[None] - t[:, None])
        z = np.maximum(p[..., 2], 1e-9)
        rays = np.stack([p[..., 0] / z, p[..., 1] / z, p[..., 2]], axis=-1)
        in_view = ((rays >= low) & (rays <= high)).all(axis=-1)
        total += (in_view & seen[chunk][:, neighbours].any(axis=-1)).sum(axis=0)
    return total


def compact(keep: BoolArray, landmark: IntArray) -> IntArray:
    """Labels of the kept landmarks, numbered anew; the others become -1."""
    number = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)  # the last one is for -1 itself
    return number[landmark]


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
    duplicate_radius: float,
    minimum: int,
    config: TrackletConfig,
) -> Array:
    """Places (k, 3) of flowers that no landmark stands for yet, among the observations left over.

    Each left-over point is moved back by the displacement (n, c, 3) of the cluster next to it, in its own frame: a
    flower that was only seen while its cluster swayed stands still after that. Where that cluster was not seen (NaN)
    nothing is known of the point. What lies within ``duplicate_radius`` of a landmark is that flower's own outliers.
    """
    left = np.flatnonzero(landmark < 0)
    if len(left) < minimum:
        return np.empty((0, 3))
    world = transform(T[frames.frame[left]], frames.points[left])
    if len(places):
        nearest = cluster[cKDTree(places).query(world)[1]]
        world = world - displacement[frames.frame[left], nearest]
        known = np.isfinite(world[:, 0])
        left, world = left[known], world[known]
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
    found = found[np.bincount(label[label >= 0], minlength=len(found)) >= minimum]
    if len(places) and len(found):
        found = found[cKDTree(places).query(found)[0] > duplicate_radius]
    return found
