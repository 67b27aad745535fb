"""Who is who, once the pose is known: clusters and single flowers one to one, new and gone, with probabilities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.constellation.match import Found
from cluster_slam.constellation.units import MATCH_FLOOR_M, spread_of
from cluster_slam.geometry import Array
from cluster_slam.records import Constellation, IntArray
from tracking.assignment import assign
from tracking.reid import association_probabilities

ELSEWHERE = 0.01  # prior of a flower that was grouped with another cluster than the map has it in
BESIDE = 0.1  # a cluster opens where another one stands so many times as often as anywhere: they would be one group
TAIL = 3.0  # some flowers' errors are so many times as large ...
TAIL_SHARE = 0.01  # ... this share of them, ...
TAIL_SHARE_SINGLE = 0.05  # ... or this, where each flower stands for itself


@dataclass(frozen=True, slots=True, eq=False)
class Identities:
    """Rows of the plant for each cluster and flower of a session, -1 where the plant does not have it."""

    cluster: IntArray  # (c,)
    cluster_probability: Array  # (c,) of this decision, match or new
    flower: IntArray  # (f,)
    flower_probability: Array  # (f,)


def nobody(session: Constellation) -> Identities:
    """All are new: the plant's first session."""
    n, f = len(session.cluster_ids), len(session.flower_ids)
    return Identities(np.full(n, -1), np.ones(n), np.full(f, -1), np.ones(f))


def identify(session: Constellation, match: Found, pose_probability: float) -> Identities:
    """Identities under the pose of a match.

    Parameters
    ----------
    pose_probability
        That the pose is right at all; every match can be no surer than that.
    """
    ratio = _flower_ratios(session, match)
    rows, cols = assign(-ratio, 0.0)
    pairs, new, _ = association_probabilities(ratio)
    flower = np.full(len(session.flower_ids), -1)
    flower[rows] = cols
    if not match.single:
        _with_their_clusters(match, flower)
    probability = np.where(flower >= 0, pose_probability * pairs[np.arange(len(flower)), flower], new)
    cluster, cluster_probability = _clusters(session, match, flower, probability, pose_probability)
    return Identities(cluster, cluster_probability, flower, np.clip(probability, 0.0, 1.0))


def _with_their_clusters(match: Found, flower: IntArray) -> None:
    """Flowers of clusters that were matched as a whole, although none of them would have been by itself."""
    scene, found = match.scene, match.best
    taken = np.zeros(len(match.plant.flowers), dtype=bool)
    taken[flower[flower >= 0]] = True
    for k in range(len(found)):
        member = np.flatnonzero(found.partner[k] >= 0)
        mine = scene.query.flower[found.query[k], member]
        theirs = scene.known.flower[found.known[k], found.partner[k, member]]
        if (flower[mine] < 0).all() and not taken[theirs].any():
            flower[mine] = theirs
            taken[theirs] = True


def _flower_ratios(session: Constellation, match: Found) -> Array:
    """Log likelihood ratios (f, g) of all pairs of flowers, given what their clusters did."""
    scene, found, space = match.scene, match.best, match.space
    points = found.pose.apply(space.session(session.flowers))[0]
    d = points.shape[1]
    where, var = _expected(match)
    own = match.scale**2 * np.trace(session.flower_covs, axis1=1, axis2=2) / 3.0
    squared = ((points[:, None] - where) ** 2).sum(-1)
    tail = TAIL_SHARE_SINGLE if match.single else TAIL_SHARE
    log_density = _log_density(squared, own[:, None] + var, d, tail, TAIL)
    if not match.single:
        _without_themselves(match, points, own, log_density)
    seen = np.clip(scene.config.seen_share * match.plant.flower_presence, 1e-3, 0.999)
    null, prior = _strangers(session, match)
    ratios: Array = log_density + np.log(seen / (1 - seen)) - null[:, None] + prior
    return ratios


def _log_density(squared: Array, var: Array, d: int, tail: float, factor: float) -> Array:
    """Log of a Gaussian of this variance along each axis, with a share ``tail`` of one ``factor`` times as wide."""
    wide = factor**2 * var
    density: Array = np.logaddexp(
        np.log1p(-tail) - 0.5 * squared / var - 0.5 * d * np.log(2 * np.pi * var),
        np.log(tail) - 0.5 * squared / wide - 0.5 * d * np.log(2 * np.pi * wide),
    )
    return density


def _without_themselves(match: Found, points: Array, own: Array, log_density: Array) -> None:
    """Log densities of flowers by which their cluster was placed: from where the cluster's other flowers put it.

    A flower that stands alone says nothing about itself: its cluster may have drifted as far as was expected, or wider.
    """
    scene, found, known = match.scene, match.best, match.scene.known
    for k in range(len(found)):
        q, u = found.query[k], found.known[k]
        member = np.flatnonzero(found.partner[k] >= 0)
        rows, theirs = scene.query.flower[q, member], np.flatnonzero(known.groups.mask[u])
        matched = known.groups.points[u, found.partner[k, member]]
        weight = 1.0 / (MATCH_FLOOR_M**2 + own[rows])
        pull = weight[:, None] * (points[rows] - matched)
        left = 1.0 / known.var_offset[u] + weight.sum() - weight
        offset = (pull.sum(axis=0) - pull) / left[:, None]
        residual = points[rows][:, None] - known.groups.points[u, theirs] - offset[:, None]
        var = own[rows][:, None] + known.groups.variances[u, theirs] + 1.0 / left[:, None]
        alone = len(member) == 1
        tail, factor = (scene.config.wide_share, scene.config.wide) if alone else (TAIL_SHARE, TAIL)
        columns = known.flower[u, theirs]
        log_density[np.ix_(rows, columns)] = _log_density((residual**2).sum(-1), var, points.shape[1], tail, factor)


def _expected(match: Found) -> tuple[Array, Array]:
    """Where the plant's flowers are expected (g, d), and their variance (g,), after what their clusters did."""
    scene, found = match.scene, match.best
    known = scene.known
    offset = np.zeros(known.centres.shape)
    var_left = known.var_offset.copy()
    if not match.single:
        offset[found.known] = found.offset
        weight = np.where(
            found.partner >= 0,
            1.0 / (MATCH_FLOOR_M**2 + scene.query.groups.variances[found.query]),
            0.0,
        ).sum(axis=1)
        var_left[found.known] = 1.0 / (1.0 / known.var_offset[found.known] + weight)
    n = len(match.plant.flowers)
    where, var = np.zeros((n, known.centres.shape[1])), np.ones(n)
    unit, member = np.nonzero(known.groups.mask)
    row = known.flower[unit, member]
    where[row] = known.groups.points[unit, member] + offset[unit]
    var[row] = known.groups.variances[unit, member] + var_left[unit]
    return where, var


def _strangers(session: Constellation, match: Found) -> tuple[Array, Array]:
    """Log density (f,) of each flower if it is new, and log prior (f, g) of the clusters of a pair being the same."""
    scene, found = match.scene, match.best
    background = scene.background
    row = np.searchsorted(session.cluster_ids, session.flower_cluster_ids)
    size = np.bincount(row, minlength=len(session.cluster_ids))[row]
    alone = (background.log_group_density + (size - 1) * background.log_density) / size
    if match.single:
        return alone, np.zeros((len(row), len(match.plant.flowers)))
    partner = np.full(len(session.cluster_ids), -1)
    partner[scene.query.cluster[found.query]] = scene.known.cluster[found.known]
    hidden = len(match.plant.flowers) / max(len(match.plant.cluster_ids), 1) * (1.0 - scene.config.seen_share)
    beside = np.log(background.n_new + hidden) + _within_cluster(session, match)
    null = np.where(partner[row] >= 0, np.maximum(beside, alone), alone)
    same = partner[row][:, None] == match.plant.flower_rows
    return null, np.where(same, 0.0, np.log(ELSEWHERE))


def _within_cluster(session: Constellation, match: Found) -> Array:
    """Log density (f,) of a new flower at each one's place: as likely about the cluster's middle as anywhere in it."""
    scene, found = match.scene, match.best
    d = scene.query.centres.shape[1]
    points = found.pose.apply(match.space.session(session.flowers))[0]
    var = spread_of(scene.background, d)
    log_density = np.full(len(points), scene.background.log_density)
    for k in range(len(found)):
        rows = scene.query.flower[found.query[k]]
        rows = rows[rows >= 0]
        middle = scene.known.centres[found.known[k]] + found.offset[k]
        squared = ((points[rows] - middle) ** 2).sum(axis=1)
        gaussian = -0.5 * squared / var - 0.5 * d * np.log(2 * np.pi * var)
        log_density[rows] = np.logaddexp(gaussian, scene.background.log_density) - np.log(2.0)
    return log_density


def _clusters(
    session: Constellation, match: Found, flower: IntArray, flower_probability: Array, pose_probability: float
) -> tuple[IntArray, Array]:
    """Partners (c,) of the clusters by the flowers that they share, one to one, and probabilities."""
    scene, found = match.scene, match.best
    n, m = len(session.cluster_ids), len(match.plant.cluster_ids)
    row = np.searchsorted(session.cluster_ids, session.flower_cluster_ids)
    shared = np.zeros((n, m))
    is_match = flower >= 0
    np.add.at(shared, (row[is_match], match.plant.flower_rows[flower[is_match]]), flower_probability[is_match])
    a, b = assign(-shared, -1e-6)
    partner = np.full(n, -1)
    partner[a] = b
    probability = np.ones(n)
    if match.single:
        probability[a] = np.minimum(1.0, shared[a, b] / np.maximum(shared[a].sum(axis=1), 1e-9)) * pose_probability
        best = np.zeros(n)
        np.maximum.at(best, row, np.where(is_match, flower_probability, 0.0))
        return partner, np.where(partner >= 0, np.minimum(probability, best), 1.0 - best)
    ratio = np.full((n, m), -np.inf)
    ratio[np.ix_(scene.query.cluster, scene.known.cluster)] = np.logaddexp(found.table, _turned_over(match))
    free = np.where((partner >= 0)[:, None] | np.isin(np.arange(m), partner), -np.inf, ratio)
    a, b = assign(-free, 0.0)
    partner[a] = b
    pairs, new, _ = association_probabilities(ratio)
    best = np.zeros(n)
    mine = is_match & (match.plant.flower_rows[flower] == partner[row])
    np.maximum.at(best, row[mine], flower_probability[mine])
    probability = np.where(partner >= 0, np.maximum(pairs[np.arange(n), partner] * pose_probability, best), new)
    return partner, np.clip(probability, 0.0, 1.0)


def _turned_over(match: Found) -> Array:
    """Log likelihood ratios (q, u) that a cluster is a known one though none of its flowers is: all others are unseen.

    Its n flowers are hidden so far, new or false, nu of which are expected there; with k known flowers and the variance
    s^2 of a flower in its cluster, their mean lies N(0, s^2/n + s^2/k + drift) from the known ones'.
    """
    scene, found = match.scene, match.best
    query, known, background = scene.query, scene.known, scene.background
    d = query.centres.shape[1]
    moved = found.pose.apply(query.centres)[0]
    n, k = (np.maximum(u.groups.mask.sum(axis=1), 1) for u in (query, known))
    inside = spread_of(background, d)
    var = inside / n[:, None] + inside / k + known.var_offset
    squared = ((moved[:, None] - known.centres) ** 2).sum(-1)
    expected = background.n_new + k * (1.0 - scene.config.seen_share)
    unseen = np.where(known.groups.mask, np.log1p(-np.clip(known.seen, 1e-3, 0.999)), 0.0).sum(axis=1)
    log_density = -0.5 * squared / var - 0.5 * d * np.log(2 * np.pi * var)
    ratio: Array = log_density + n[:, None] * np.log(expected) - expected + unseen - scene.bonus[:, None]
    ratio -= background.log_group_density + np.log(BESIDE)
    return ratio
