"""Maps between gaps become one: the largest first, then what joins most clearly.

In a gap several motions are possible: each is tried, and the likeliest whole is kept.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.association.drift_growth import grow
from cluster_slam.association.drift_labels import State
from cluster_slam.association.drift_session import DriftSession
from cluster_slam.association.submaps import Part, joined, matched, motions, spans_between_gaps


def assemble(session: DriftSession) -> State:
    """Map what lies between gaps for itself, then join the parts: the largest, then what joins most clearly."""
    spans = spans_between_gaps(session.steps, session.frames.n_frames, session.config.gap_steps)
    parts = [_part(session, *span) for span in spans]
    low = high = int(np.argmax([part.weight for part in parts]))
    whole = parts[low]
    if whole.weight == 0:
        return grow(session)
    while low > 0 or high + 1 < len(parts):
        sides = [k for k in (low - 1, high + 1) if 0 <= k < len(parts)]
        ranked = [_joined(session, whole, parts[k]) for k in sides]
        clearest = int(np.argmax([share for _, share in ranked]))
        whole = ranked[clearest][0]
        low, high = min(low, sides[clearest]), max(high, sides[clearest])
    return State(whole.T, whole.label, whole.places, 0.0)


def _part(session: DriftSession, first: int, end: int) -> Part:
    """What was seen between two gaps; where that is little, it waits for a map of its surroundings."""
    piece = session.between(first, end)
    n = len(piece.frames)
    if n < session.config.fewest_points:
        return _as_part(piece, State(piece.given, np.full(n, -1), np.empty((0, 3)), 0.0), first)
    return _as_part(piece, grow(piece), first)


def _as_part(session: DriftSession, state: State, first: int) -> Part:
    """A state as a part of a session, whose first frame it is."""
    var = session.place_covs(state)[:, 0, 0] * session.config.submap_slack**2
    return Part(first, first + len(state.T), state.T, state.label, state.places, var, session.frames.frame)


def _joined(session: DriftSession, a: Part, b: Part) -> tuple[Part, float]:
    """Both parts as one, and the share of the points of b that landmarks of a explain."""
    if len(b.places) == 0:
        return joined(a, b, np.zeros(session.steps.basis.shape[1]), session.steps), 1.0
    union, price = session.between(min(a.first, b.first), max(a.end, b.end)), session.config.growing_cost
    tries = []
    for z in motions(a, b, session.steps, session.config.n_motions):
        trial = matched(joined(a, b, z, session.steps), len(a.places))
        tries.append(union.labels.settle(trial.T, trial.label, trial.places, price, 1))
    tries.sort(key=lambda state: state.cost)
    best = union.labels.merge(tries[0], price)
    own = np.isin(union.frames.order, session.between(b.first, b.end).frames.order)
    known = np.unique(best.label[np.logical_not(own)])
    share = float(np.isin(best.label[own], known[known >= 0]).mean())
    return _as_part(union, best, min(a.first, b.first)), share
