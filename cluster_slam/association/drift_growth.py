"""A map of what lies between two gaps, grown stretch by stretch.

Each stretch is gone through with particles; then all poses and places so far are smoothed, all points are associated
again, and landmarks are merged where that makes the whole likelier, each landmark having a price.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.association.drift_labels import State
from cluster_slam.association.drift_session import DriftSession
from cluster_slam.association.particles import trace_stretch

_GAP = 5.0  # usual steps; what is longer is a gap, in which nothing was seen
_SHORT = 10  # frames that would be left over for a last stretch


def grow(session: DriftSession) -> State:
    """Go through the session, stretch by stretch."""
    n, starts, config = session.frames.n_frames, session.frames.starts, session.config
    state = State(np.empty((0, 4, 4)), np.empty(0, dtype=np.int64), np.empty((0, 3)), 0.0)
    done = 0
    while done < n:
        end = min(max(done + 1, int(np.searchsorted(starts, starts[done] + config.stretch_points))), n)
        ahead = min(int(np.searchsorted(starts, starts[end] + config.ahead_points)), n)
        if n - end < _SHORT:
            end = ahead = n
        after_gap = done == 0 or bool((session.steps.length[done - 1 : ahead - 1] > _GAP).any())
        if after_gap:
            end = ahead
        n_tries = config.n_tries if after_gap else 1
        tries = [_extended(session, state, (done, end, ahead), after_gap) for _ in range(n_tries)]
        state = min(tries, key=lambda s: s.cost)
        done = end
    return state


def _extended(session: DriftSession, state: State, span: tuple[int, int, int], after_gap: bool) -> State:
    """Associate the frames ``span`` (from, to, and to where it is looked ahead) and smooth all so far."""
    done, end, ahead = span
    config, starts = session.config, session.frames.starts
    found = trace_stretch(
        session.frames,
        session.steps,
        (done, ahead),
        state.T[-1] if done else session.given[0],
        state.places,
        session.place_covs(state),
        config.n_particles * (2 if after_gap else 1),
        config,
        rng=session.rng,
    )
    T = np.concatenate([state.T, found.T[: end - done]])
    label = np.concatenate([state.label, found.label[: int(starts[end] - starts[done])]])
    labels, price = session.labels, config.growing_cost
    return labels.merge(labels.settle(T, label, found.places, price), price)
