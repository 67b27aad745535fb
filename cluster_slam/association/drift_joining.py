"""Maps between gaps become one: neighbours first between which odometry drifts least.

In a gap several motions are possible, and the points of one part often cannot tell them apart: tubes in a row look
like other tubes in a row. So several wholes are carried along, and what is seen later decides between them. So are
several maps of each part, whose own points need not tell two landmarks from one.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from cluster_slam.association.compatibility import Matches, decided_otherwise, match_jointly
from cluster_slam.association.drift_growth import grow
from cluster_slam.association.drift_labels import State
from cluster_slam.association.drift_redo import redo, redo_once
from cluster_slam.association.drift_session import DriftSession
from cluster_slam.association.drift_smoother import DriftSmoother
from cluster_slam.association.drift_split import split
from cluster_slam.association.particles import view_cells
from cluster_slam.association.submaps import (
    Part,
    gap_cov,
    gap_drift,
    identified,
    joined,
    motions,
    sides,
    spans_between_gaps,
)
from cluster_slam.geometry import Array

_SAME = 0.98  # of the points have the same landmark: then two maps are one
_FEW_MERGES = 5  # pairs of landmarks that are tried as one when stretches have been associated again
_N_RECONSIDERED = 6  # joint matches whose decisions are taken back one by one
_N_AGAIN = 2  # ways of joining maps in which the stretches of the smaller map are


def assemble(session: DriftSession) -> list[State]:
    """Wholes of a session, the likeliest first."""
    spans = spans_between_gaps(session.steps, session.frames.n_frames, session.config.gap_steps)
    parts = [_maps(session, *span) for span in spans]
    if all(maps[0].weight == 0 for maps in parts):
        return [grow(session)]
    range_sq = float(np.median((session.frames.points**2).sum(axis=1)))
    while len(parts) > 1:
        drift = [gap_drift(a[0], b[0], session.steps, range_sq) for a, b in pairwise(parts)]
        k = int(np.argmin(drift))
        parts[k : k + 2] = [_joined(session, *sorted(parts[k : k + 2], key=lambda maps: -maps[0].weight))]
    return [State(part.T, part.label, part.places, part.cost) for part in parts[0]]


def _maps(session: DriftSession, first: int, end: int) -> list[Part]:
    """What was seen between two gaps, the likeliest first; where that is little, it waits for a map around it."""
    piece = session.between(first, end)
    n = len(piece.frames)
    if n < session.config.fewest_points:
        return [as_part(piece, State(piece.given, np.full(n, -1), np.empty((0, 3)), 0.0), first)]
    price, n_maps = session.config.growing_cost, session.config.n_maps
    grown: list[State] = []
    while len(grown) < n_maps and len(_best(grown, n_maps)) == len(grown):  # until two are the same
        grown.append(grow(piece))
    likely = _best(grown, n_maps, 2.0 * session.config.lead)
    again = [redo(piece, state, price, _FEW_MERGES) for state in likely]
    return [as_part(piece, state, first) for state in _best(again, n_maps)]


def as_part(session: DriftSession, state: State, first: int) -> Part:
    """A state as a part of a session, whose first frame it is."""
    var = session.place_covs(state)[:, 0, 0] * session.config.submap_slack**2
    frame = session.frames.frame
    return Part(first, first + len(state.T), state.T, state.label, state.places, var, frame, state.cost)


def _joined(session: DriftSession, large: list[Part], small: list[Part]) -> list[Part]:
    """The maps of two neighbours as one, in the likeliest ways.

    Whether one way is likelier than another shows when landmarks have been merged and parted in both: one that two
    tubes share, or two that are one tube, hide what speaks for the right way.
    """
    config, first = session.config, min(large[0].first, small[0].first)
    union = session.between(first, max(large[0].end, small[0].end))
    if len(small[0].places) == 0:
        z = np.zeros(session.steps.basis.shape[1])
        both = [joined(a, small[0], z, session.steps) for a in large]
        return [replace(part, cost=a.cost) for part, a in zip(both, large, strict=True)]
    price = config.growing_cost
    ways = [union.labels.settle(way.T, way.label, way.places, price, 2) for way in _ways(session, large, small)]
    span = (small[0].first - first, small[0].end - first)
    likely = _best(ways, config.n_wholes, 2.0 * config.lead)
    merged = [split(union.labels, union.labels.merge(way, price), price) for way in likely]
    best = _best(merged, config.n_wholes, config.lead)
    again = [redo_once(union, way, span, price, _FEW_MERGES) for way in best[:_N_AGAIN]]
    return [as_part(union, way, first) for way in _best([*again, *best[_N_AGAIN:]], config.n_wholes, config.lead)]


def _ways(session: DriftSession, large: list[Part], small: list[Part]) -> list[Part]:
    """Every map of a part with every map of its neighbour, with the matches that are likeliest jointly."""
    config, steps = session.config, session.steps
    log_volume = float(np.log(view_cells(session.frames)))
    found: list[tuple[float, Part]] = []
    for a in large:
        for b in small:
            both = sides(a, b, (_place_covs(session, a, b), _place_covs(session, b, a)), steps)
            prior = gap_cov(a, b, steps)
            starts = motions(*both, prior, steps.basis, config.n_motions)
            matches = _differing([match_jointly(*both, start, prior, steps.basis, log_volume) for start in starts])
            others = decided_otherwise(*both, matches[:_N_RECONSIDERED], prior, steps.basis, log_volume)
            for match in _differing([*matches, *others])[: config.n_ways]:
                way = identified(joined(a, b, match.z, steps), a, match.pairs)
                found.append((a.cost + b.cost - match.score, way))
    found.sort(key=lambda way: way[0])
    return [way for _, way in found[: config.n_ways]]


def _differing(matches: list[Matches]) -> list[Matches]:
    """The matches of different landmarks, the likeliest first."""
    different: dict[tuple[tuple[int, ...], ...], Matches] = {}
    for match in sorted(matches, key=lambda match: -match.score):
        different.setdefault(tuple(sorted(map(tuple, match.pairs.tolist()))), match)
    return list(different.values())


def _place_covs(session: DriftSession, part: Part, neighbour: Part) -> Array:
    """Joint covariance (3 l, 3 l) of the places of a part whose pose beside the neighbour stays."""
    local = session.between(part.first, part.end)
    fixed = len(part.T) - 1 if neighbour.first >= part.end else 0
    smoother = DriftSmoother(local.frames, local.steps, session.config.point_dof, fixed=fixed)
    return smoother.place_covs(part.T, part.places, part.label)


def _best(states: list[State], n: int, lead: float = np.inf, same: float = _SAME) -> list[State]:
    """The likeliest states that differ, at most n, of those that cost at most ``lead`` more than the best."""
    states = sorted(states, key=lambda state: state.cost)
    chosen: list[State] = []
    for state in states:
        near = len(chosen) < n and state.cost <= states[0].cost + lead
        if near and all(_share_alike(state, other) < same for other in chosen):
            chosen.append(state)
    return chosen


def _share_alike(a: State, b: State) -> float:
    """Share of the points that have the same landmark in both, each landmark of a being the one of b it meets most."""
    table = np.zeros((len(a.places) + 1, len(b.places) + 1))
    np.add.at(table, (a.label, b.label), 1.0)
    return float(table.max(axis=1).sum() / max(table.sum(), 1.0))
