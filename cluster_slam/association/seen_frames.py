"""The frames in which something was seen, as a session of their own, and the way between them afterwards.

A robot may tell its pose far more often than a detector finds a point: what lies between two points is one step of
odometry then, as uncertain as the steps it is made of.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from cluster_slam.association.frames import Frames
from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, se3_log
from cluster_slam.records import IntArray


def seen_frames(frames: Frames) -> IntArray:
    """Frames with a point."""
    return np.flatnonzero(np.diff(frames.starts) > 0)


def only_seen(frames: Frames, kept: IntArray) -> Frames:
    """The session of the frames ``kept``, which hold all points."""
    number = np.zeros(frames.n_frames, dtype=np.int64)
    number[kept] = np.arange(len(kept))
    starts = np.append(frames.starts[kept], len(frames))
    return replace(frames, starts=starts, frame=number[frames.frame], stamps=frames.stamps[kept])


def summed_steps(T: Array, cov_step: Array, kept: IntArray) -> Array:
    """Covariances of the steps between the poses ``kept`` of T (n, 4, 4), tangent at their ends.

    T_a M_1 Exp(e_1) M_2 Exp(e_2) is, to first order, T_a M_1 M_2 Exp(Ad(M_2^-1) e_1 + e_2).
    """
    out = np.empty((max(len(kept) - 1, 0), 6, 6))
    for s, (a, b) in enumerate(pairwise(kept)):
        A = adjoint(inverse(T[b]) @ T[a + 1 : b + 1])
        out[s] = np.sum(A @ cov_step[a:b] @ np.swapaxes(A, 1, 2), axis=0)
    return out


def filled(T: Array, kept: IntArray, given: Array) -> Array:
    """Poses of all frames (n, 4, 4) from those ``kept`` (k, 4, 4): ``given`` between them, its error shared."""
    n = len(given)
    before = np.clip(np.searchsorted(kept, np.arange(n), side="right") - 1, 0, len(kept) - 1)
    after = np.minimum(before + 1, len(kept) - 1)
    home = T @ inverse(given[kept])  # of the world of odometry, at each frame kept
    error = se3_log(inverse(given[kept[after]]) @ inverse(home[before]) @ home[after] @ given[kept[after]])
    length = np.maximum(kept[after] - kept[before], 1)
    share = np.clip((np.arange(n) - kept[before]) / length, 0.0, 1.0)
    return np.asarray(home[before] @ given @ se3_exp(share[:, None] * error))


def step_of_each(values: Array, kept: IntArray, n_steps: int) -> Array:
    """Values (k - 1,) of the steps between the frames ``kept`` for each of all steps (n_steps,); 1 outside of them."""
    step = np.searchsorted(kept, np.arange(n_steps), side="right") - 1
    inside = (step >= 0) & (step < len(values))
    return np.where(inside, values[np.clip(step, 0, max(len(values) - 1, 0))], 1.0) if len(values) else np.ones(n_steps)
