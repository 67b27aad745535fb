"""Every stretch of a session is associated once more, with the landmarks that the others support."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.drift_labels import State
from cluster_slam.association.drift_session import DriftSession
from cluster_slam.association.drift_smoother import DriftSmoother
from cluster_slam.association.drift_split import split
from cluster_slam.association.particles import trace_stretch
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray


def redo(session: DriftSession, state: State, price: float, n_merges: int = 12) -> State:
    """Associate every stretch again, and part landmarks that are two, as long as that helps; landmarks have a price.

    After the first pass only where the pass before has changed something.
    """
    todo = spans(session, session.config.stretch_points)
    for _ in range(session.config.n_redo):
        new, changed = _pass(session, state, todo, price, n_merges)
        new = split(session.labels, new, price)
        if new.cost >= state.cost - 1.0:
            break
        state = new
        todo = [span for span in todo if any(span[0] < end and span[1] > first for first, end in changed)]
    return state


def redo_once(session: DriftSession, state: State, within: tuple[int, int], price: float, n_merges: int = 12) -> State:
    """Associate the stretches that reach into the frames ``within`` (from, to) again; landmarks have a price."""
    todo = spans(session, session.config.stretch_points)
    todo = [(first, end) for first, end in todo if first < within[1] and end > within[0]]
    return _pass(session, state, todo, price, n_merges)[0]


def _pass(
    session: DriftSession, state: State, todo: list[tuple[int, int]], price: float, n_merges: int
) -> tuple[State, list[tuple[int, int]]]:
    """Associate spans again, one after the other; the state, merged, and the spans that have changed."""
    new, changed = state, []
    for span in todo:
        before, new = new, _redo_span(session, new, span, price)
        if new is not before:
            changed.append(span)
    if not changed:
        return state, []
    return session.labels.merge(session.labels.settle(new.T, new.label, new.places, price), price, n_merges), changed


def spans(session: DriftSession, n_points: int) -> list[tuple[int, int]]:
    """Frames with ``n_points`` points each, every two neighbours overlapping by half."""
    frames, half = session.frames, n_points // 2
    bounds = [*frames.frame[0 : max(len(frames) - half, 1) : half].tolist(), frames.n_frames]
    bounds = sorted({0, *bounds})
    return list(zip(bounds[:-2], bounds[2:], strict=True)) or [(0, frames.n_frames)]


def _redo_span(session: DriftSession, state: State, span: tuple[int, int], price: float) -> State:
    """Associate the frames of a span again, if that is likelier there, the rest of the session standing still."""
    around = Surroundings.of(session, state, span)
    old = around.smoothed(state)
    found = trace_stretch(
        around.part.frames,
        around.part.steps,
        (around.span[0] - around.first, around.span[1] - around.first),
        state.T[max(span[0] - 1, 0)],
        state.places,
        around.covs,
        session.config.n_particles,
        session.config,
        rng=session.rng,
    )
    new = around.associated(state, found.T, found.label, found.places)
    n_new = len(np.unique(new.label[new.label >= len(state.places)]))
    changed, before = around.put_into(state, new), around.put_into(state, old)
    if new.cost + price * n_new + _choice(session, changed) >= old.cost + _choice(session, before) - 1e-6:
        return state
    return changed


def _choice(session: DriftSession, state: State) -> float:
    return session.labels.choice_cost(state.T, state.places, state.label)


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """A span of frames (from, to) with half as much on either side, which may move with it; the rest stands still."""

    part: DriftSession
    smoother: DriftSmoother
    covs: Array  # (l, 3, 3) of the places as all other points know them
    span: tuple[int, int]
    first: int  # frame
    around: slice  # of points of the session
    inside: slice  # of points of the part

    @staticmethod
    def of(session: DriftSession, state: State, span: tuple[int, int]) -> Surroundings:
        """The surroundings of a span."""
        a, b = span
        starts = session.frames.starts
        first, end = max(0, a - (b - a) // 2), min(session.frames.n_frames, b + (b - a) // 2)
        around = slice(int(starts[first]), int(starts[end]))
        inside = slice(int(starts[a]) - around.start, int(starts[b]) - around.start)
        elsewhere = state.label.copy()
        elsewhere[around] = -1
        covs = session.place_covs(State(state.T, elsewhere, state.places, 0.0))
        part = session.between(first, end)
        smoother = DriftSmoother(part.frames, part.steps, part.config.point_dof, state.places, 1.0 / covs[:, 0, 0])
        return Surroundings(part, smoother, covs, span, first, around, inside)

    @property
    def frames(self) -> slice:
        """Frames of the session that may move."""
        return slice(self.first, self.first + self.part.frames.n_frames)

    def smoothed(self, state: State) -> State:
        """The part as it is associated, smoothed."""
        label = state.label[self.around]
        return self._state(*self.smoother.solve(state.T[self.frames], state.places, label), label)

    def associated(self, state: State, T: Array, label: IntArray, places: Array) -> State:
        """The part with the span at other poses (k, 4, 4) and with other labels, smoothed, associated, smoothed."""
        a, b = self.span
        all_T, all_label = state.T[self.frames].copy(), state.label[self.around].copy()
        all_T[a - self.first : b - self.first], all_label[self.inside] = T, label
        all_T, places = self.smoother.solve(all_T, places, all_label)
        all_label[self.inside] = self.part.labels.associate(self.smoother, all_T, places)[self.inside]
        return self._state(*self.smoother.solve(all_T, places, all_label), all_label)

    def nearest(self, T: Array, places: Array) -> IntArray:
        """Labels of the points of the span were its poses (k, 4, 4)."""
        a, b = self.span[0] - self.first, self.span[1] - self.first
        only = self.part.between(a, b)
        smoother = DriftSmoother(only.frames, only.steps, only.config.point_dof)
        return only.labels.associate(smoother, T, places)

    def put_into(self, state: State, part: State) -> State:
        """The whole with the part in it; new places last."""
        T, label = state.T.copy(), state.label.copy()
        T[self.frames], label[self.around] = part.T, part.label
        return State(T, label, np.concatenate([state.places, part.places[len(state.places) :]]), np.inf)

    def _state(self, T: Array, places: Array, label: IntArray) -> State:
        clutter = self.part.config.clutter_cost * int((label < 0).sum())
        return State(T, label, places, self.smoother.cost(T, places, label) + clutter)
