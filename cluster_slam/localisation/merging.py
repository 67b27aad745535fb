"""Points of a few frames in a row as one look: what was seen again stays, what was not is false."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_slam.geometry import Array, transform
from cluster_slam.localisation.scene import Look
from tracking.assignment import assign

_SIGMAS = 4.0  # by which a point may miss the mean of those before it
_LEAST_SHARE = 0.3  # of the frames in which a flower must have been seen, where there are enough frames to ask
_ENOUGH = 3


def merged_points(looks: Sequence[Look], to_last: Array, slack_m: float) -> Array:
    """Places (n, 3) in the last frame's camera of what several looks have seen.

    Parameters
    ----------
    looks : of frames in a row.
    to_last : (k, 4, 4) motion from each frame's camera to the last one's, ``T_last_camera``.
    slack_m : by how much a place may differ from look to look, one sigma: sway, errors of the motion.
    """
    mean, count = np.zeros((0, 3)), np.zeros(0)
    for look, T in zip(looks, to_last, strict=True):
        places = transform(T, look.points)
        sigma = np.sqrt(2.0 * (look.sigma**2 + slack_m**2))
        off = np.linalg.norm(places[:, None] - mean, axis=2) / np.maximum(sigma[:, None], 1e-12)
        rows, columns = assign(off, _SIGMAS)
        count[columns] += 1.0
        mean[columns] += (places[rows] - mean[columns]) / count[columns, None]
        new = np.setdiff1d(np.arange(len(places)), rows)
        mean, count = np.vstack([mean, places[new]]), np.append(count, np.ones(len(new)))
    if len(looks) >= _ENOUGH:
        mean = mean[count >= max(2.0, _LEAST_SHARE * len(looks))]
    return mean
