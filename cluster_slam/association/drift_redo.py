"""Every stretch of a session is associated once more, with the landmarks that the others support."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.drift_labels import State, choice_cost
from cluster_slam.association.drift_session import DriftSession
from cluster_slam.association.drift_smoother import DriftSmoother
from cluster_slam.association.particles import trace_stretch
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray


def redo(session: DriftSession, state: State) -> State:
    """Associate every stretch again, as long as that helps."""
    price = session.config.landmark_cost
    for _ in range(session.config.n_redo):
        new = state
        for span in _spans(session):
            new = _redo_span(session, new, span, price)
        new = session.labels.merge(session.labels.settle(new.T, new.label, new.places, price), price)
        if new.cost >= state.cost - 1.0:
            break
        state = new
    return state


def _spans(session: DriftSession) -> list[tuple[int, int]]:
    """Frames with ``stretch_points`` points each, every two neighbours overlapping by half."""
    frames, half = session.frames, session.config.stretch_points // 2
    bounds = [*frames.frame[0 : max(len(frames) - half, 1) : half].tolist(), frames.n_frames]
    bounds = sorted({0, *bounds})
    return list(zip(bounds[:-2], bounds[2:], strict=True)) or [(0, frames.n_frames)]


def _redo_span(session: DriftSession, state: State, span: tuple[int, int], price: float) -> State:
    """Associate the frames of a span again, if that is likelier there, the rest of the session standing still."""
    a, b = span
    starts = session.frames.starts
    first, end = max(0, a - (b - a) // 2), min(session.frames.n_frames, b + (b - a) // 2)
    around = slice(int(starts[first]), int(starts[end]))
    inside = slice(int(starts[a]) - around.start, int(starts[b]) - around.start)
    covs = _covs_elsewhere(session, state, around)
    part = session.between(first, end)
    smoother = DriftSmoother(part.frames, part.steps, part.config.point_dof, state.places, 1.0 / covs[:, 0, 0])
    old = _local(part, smoother, state.T[first:end], state.label[around], state.places)
    found = trace_stretch(
        part.frames,
        part.steps,
        (a - first, b - first),
        state.T[max(a - 1, 0)],
        state.places,
        covs,
        part.config.n_particles,
        part.config,
        rng=part.rng,
    )
    T, label = state.T[first:end].copy(), state.label[around].copy()
    T[a - first : b - first], label[inside] = found.T, found.label
    new = _local(part, smoother, T, label, found.places, inside)
    n_new = len(np.unique(new.label[new.label >= len(state.places)]))
    changed, before = _with(state, first, around, new), _with(state, first, around, old)
    if new.cost + price * n_new + choice_cost(changed.label) >= old.cost + choice_cost(before.label) - 1e-6:
        return state
    return changed


def _with(state: State, first: int, around: slice, part: State) -> State:
    """A state in which frames from ``first`` on, with the points ``around``, are those of a part; new places last."""
    T, label = state.T.copy(), state.label.copy()
    T[first : first + len(part.T)], label[around] = part.T, part.label
    return State(T, label, np.concatenate([state.places, part.places[len(state.places) :]]), np.inf)


def _covs_elsewhere(session: DriftSession, state: State, around: slice) -> Array:
    """How well the places are known (l, 3, 3) without the points ``around``."""
    elsewhere = state.label.copy()
    elsewhere[around] = -1
    return session.place_covs(State(state.T, elsewhere, state.places, 0.0))


def _local(
    part: DriftSession,
    smoother: DriftSmoother,
    T: Array,
    label: IntArray,
    places: Array,
    again: slice | None = None,
) -> State:
    """Smoothed with places that others hold; the points ``again`` are associated once more."""
    T, places = smoother.solve(T, places, label)
    if again is not None:
        label = label.copy()
        label[again] = part.labels.associate(smoother, T, places)[again]
        T, places = smoother.solve(T, places, label)
    clutter = part.config.clutter_cost * int((label < 0).sum())
    return State(T, label, places, smoother.cost(T, places, label) + clutter)
