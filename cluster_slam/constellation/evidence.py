"""How much what a pose explains says for the plant: the log of a Bayes factor, with the pose integrated out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import betaln, gammaln

from cluster_slam.constellation.explain import Explained, Scene, matched_pairs, n_flowers
from cluster_slam.constellation.fit import Pairs, pose_covariance
from cluster_slam.constellation.units import log_volume
from cluster_slam.constellation.warp import field_log_density

SEEN_PRIOR = 4.0  # Beta(4, 1) of the share of the plant's units that a session sees


def is_too_few(found: Explained, d: int, *, single: bool) -> bool:
    """Whether what was matched leaves the pose open: three flowers fix it, of two clusters at least."""
    return len(found) < (d if single or d == 2 else 2) or n_flowers(found) < d


def evidence_of(scene: Scene, found: Explained, *, single: bool) -> float:
    """Log likelihood ratio with the pose integrated out (Laplace): the peak times its volume over the prior's.

    The prior is uniform over all turns and over places where the session overlaps the plant.
    """
    d = scene.query.centres.shape[1]
    if is_too_few(found, d, single=single):
        return -np.inf
    pairs = _in_three(matched_pairs(scene, found))
    with_scale = scene.scale_range[0] < scene.scale_range[1]
    cov = pose_covariance(pairs, float(found.pose.scale[0]), with_scale=with_scale)
    keep = [0, 1, 2, 3, 4, 5] if d == 3 else [2, 3, 4]
    _, log_det = np.linalg.slogdet(cov[np.ix_(keep, keep)])
    turns = np.log(8 * np.pi**2) if d == 3 else np.log(2 * np.pi)
    volume = 0.5 * len(keep) * np.log(2 * np.pi) + 0.5 * log_det
    occam = volume - turns - log_volume(scene.known.centres)
    if with_scale:  # how sharply the scale is known against its range
        size = np.sqrt(((pairs.a - pairs.a.mean(0)) ** 2).sum() * len(pairs.a) / max(pairs.n_units, 1) / len(pairs.a))
        sigma = np.sqrt(float(np.median(pairs.var_offset + pairs.variance.mean())) / max(pairs.n_units, 1)) / size
        occam += min(0.0, np.log(2.5 * sigma / (scene.scale_range[1] - scene.scale_range[0])))
    ratio = _single_ratio(scene, found) if single else found.log_ratio
    return float(ratio + min(occam, 0.0) + _shares(scene, found))


def _single_ratio(scene: Scene, found: Explained) -> float:
    """Log likelihood ratio of flowers that were matched one by one: each drifts for itself, or all in a smooth field.

    What is seen and what is new is left to :func:`_shares`.
    """
    seen = np.clip(scene.known.seen[found.known, 0], 1e-3, 0.999)
    alone = found.log_ratio + len(found) * scene.background.n_new - float(np.log(seen).sum())
    strangers = len(found) * scene.background.log_group_density + float(scene.bonus[found.query].sum())
    together = field_log_density(scene, found) - strangers
    return float(np.logaddexp(alone, together) - np.log(2.0))


def _shares(scene: Scene, found: Explained) -> float:
    """What it costs that only some units found a partner: how many of either side would, nobody knows beforehand.

    Of the n known units that are still there, m certain ones are seen, each with one probability ~ Beta(4, 1):
    B(m + 4, n - m + 1) / B(4, 1). Of the session's k clusters, k - m are new, a Poisson number of a rate that is not
    known, as all k would be on another plant: (k - m)! / k!, and the count that their density under "another plant"
    holds, m times. A single flower is a share of its cluster.
    """
    m = float(len(found))
    still_there = 1.0 - np.prod(1.0 - np.where(scene.known.groups.mask, scene.known.seen, 0.0), axis=1)
    n = max(m, min(float(still_there.sum()) / scene.config.seen_share, float(len(scene.known))))
    seen = betaln(m + SEEN_PRIOR, n - m + 1.0) - betaln(SEEN_PRIOR, 1.0)
    size = np.bincount(scene.query.cluster)
    matched = float((1.0 / size[scene.query.cluster[found.query]]).sum())
    k, known = (len(np.unique(u.cluster)) for u in (scene.query, scene.known))
    log_count = 0.5 * (np.log(k) + np.log(known))  # as in `background_of`
    return float(seen + gammaln(max(k - matched, 0.0) + 1.0) - gammaln(k + 1.0) + matched * log_count)


def _in_three(pairs: Pairs) -> Pairs:
    """Pairs of a plane as pairs in three dimensions."""
    if pairs.a.shape[1] == 3:
        return pairs
    zero = np.zeros((len(pairs.a), 1))
    return replace(pairs, a=np.hstack([pairs.a, zero]), b=np.hstack([pairs.b, zero]))
