"""Which clusters swing in a frame, and how far: most hang still, a few were touched of late.

The swing of a touched cluster dies away exponentially, so its size when somebody looks is spread evenly over its
logarithm: a mixture of normal distributions with sigmas in equal ratios (a scale mixture; West, 1987). A touch shakes
neighbours too, so the share of touched clusters is that of the frame, which its own clusters tell.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.localisation.scene import ErrorScale
from tracking.gating import matching_log_likelihood

_SIZES = np.array([1.0 / 9.0, 1.0 / 3.0, 1.0])  # of the largest swing
_N_ROUNDS = 3
_PRIOR_CLUSTERS = 3.0  # so many the usual share counts for, against the frame's own clusters


def variances(scale: ErrorScale) -> Array:
    """What each of the sizes of swing adds to the variance of a displacement an axis (k,), m^2; the first: none."""
    return np.concatenate([[0.0], (_SIZES * scale.touched_m) ** 2])


def shares(displacements: Array, covs: Array, scale: ErrorScale) -> tuple[Array, Array]:
    """Probabilities (c, k) that each cluster swings by each size, and what they were before it was looked at (k,).

    Parameters
    ----------
    displacements : (c, 3) m, of each cluster from where it is expected, as its own points have it.
    covs : (c, 3, 3) their covariances, did they all hang still.
    """
    added = variances(scale)
    total = covs[:, None] + added[:, None, None] * np.eye(3)
    logs = matching_log_likelihood(
        np.broadcast_to(displacements[:, None], total.shape[:-1]).reshape(-1, 3), total.reshape(-1, 3, 3)
    ).reshape(len(covs), -1)
    touched = scale.touched_share
    for _ in range(_N_ROUNDS):
        prior = np.concatenate([[1.0 - touched], np.full(len(_SIZES), touched / len(_SIZES))])
        weighed = logs + np.log(np.maximum(prior, 1e-300))
        p = np.exp(weighed - weighed.max(axis=1, keepdims=True))
        p /= p.sum(axis=1, keepdims=True)
        swinging = float(p[:, 1:].sum())
        touched = (scale.touched_share * _PRIOR_CLUSTERS + swinging) / (_PRIOR_CLUSTERS + len(covs))
        if scale.touched_share < 1e-6:
            break
    return p, prior


def surprise(p: Array, prior: Array) -> float:
    """Divergence (nats) of the probabilities (c, k) from what they were: what it costs to say who swings."""
    ratio = np.log(np.maximum(p, 1e-300) / np.maximum(prior, 1e-300))
    return float((p * ratio).sum())


def unseen_variance(scale: ErrorScale) -> float:
    """Variance an axis, m^2, of a pose by touches that a single frame cannot see.

    A touch moves neighbours the same way at first: where all that is in view was touched it looks like a camera that
    moved. That is as likely as a cluster is touched, in a recording whose frames have shown how often that is.
    """
    return scale.touched_share * float(variances(scale)[1:].mean())
