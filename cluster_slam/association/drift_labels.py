"""Which landmark each point of a drifting session is, where poses are nearly right: smooth, associate, merge, again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from cluster_slam.association.drift_smoother import DriftSmoother, Steps
from cluster_slam.association.frames import Frames
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_BESIDE = 0.1  # of the picture's width: so far outside of what was seen a landmark still counts as in view


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Poses, labels and places of the frames so far, and what they cost."""

    T: Array
    label: IntArray
    places: Array
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Labels (m,) and places (l, 3) to try, and a name by which the same trial is known again."""

    label: IntArray
    places: Array
    key: tuple[float, ...]

    @staticmethod
    def of(label: IntArray, places: Array, changed: Array) -> Trial:
        """Named by where the landmarks stood that are changed, (3,) or (k, 3)."""
        return Trial(label, places, tuple(np.round(changed.ravel(), 1).tolist()))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What the camera sees: angles off its axis (2,), lowest and highest, and the largest range."""

    low: Array
    high: Array
    range_m: float

    @staticmethod
    def of(points: Array) -> View:
        """The view that points (m, 3) in the camera's frame show."""
        if len(points) == 0:
            return View(np.zeros(2), np.zeros(2), 0.0)
        angles = _angles(points)
        low, high = np.quantile(angles, [0.005, 0.995], axis=0)
        beside = _BESIDE * float((high - low).max())
        return View(low - beside, high + beside, float(np.linalg.norm(points, axis=1).max()))

    def holds(self, points: Array) -> BoolArray:
        """Which points (..., 3) in the camera's frame are in view."""
        angles = _angles(points)
        inside = ((angles > self.low) & (angles < self.high)).all(axis=-1)
        near: BoolArray = inside & (np.linalg.norm(points, axis=-1) < self.range_m)
        return near


def _angles(points: Array) -> Array:
    return np.arctan2(points[..., :2], points[..., 2:])


class Labelling:
    """Labels of the points of one session, given poses to begin with."""

    def __init__(self, frames: Frames, steps: Steps, config: ParticleConfig, view: View | None = None) -> None:
        self.frames, self.steps, self.config = frames, steps, config
        self.view = View.of(frames.points) if view is None else view

    def settle(self, T: Array, label: IntArray, places: Array, price: float, n_rounds: int = 3) -> State:
        """Smooth, associate again, until nothing changes."""
        smoother = self.smoother(len(T))
        places, label = _compact(places, label)
        for _ in range(n_rounds):
            T, places = smoother.solve(T, places, label)
            again = self.associate(smoother, T, places)
            same = float((again == label).mean())
            places, label = _compact(places, again)
            if same > 0.998:
                break
        T, places = smoother.solve(T, places, label)
        clutter = self.config.clutter_cost * int((label < 0).sum())
        cost = smoother.cost(T, places, label) + clutter + price * len(places) + self.choice_cost(T, places, label)
        return State(T, label, places, cost)

    def smoother(self, n: int) -> DriftSmoother:
        """What smooths the first n frames."""
        f = self.frames
        k = int(f.starts[n])
        part = Frames(f.order[:k], f.starts[: n + 1], f.frame[:k], f.points[:k], f.covs[:k], f.stamps[:n])
        return DriftSmoother(part, self.steps.between(0, n), self.config.point_dof)

    def associate(self, smoother: DriftSmoother, T: Array, places: Array) -> IntArray:
        """Landmark of each point (m,), one to one in every frame; -1 where none fits."""
        limit, frames = self.config.clutter_cost, smoother.frames
        if len(places) == 0:
            return np.full(len(frames), -1)
        cost = smoother.point_cost(smoother.distances(T, places))
        label = cost.argmin(axis=1)
        label[cost.min(axis=1) > limit] = -1
        for i in np.flatnonzero(np.diff(frames.starts) > 1):
            here = frames.of(int(i))
            q = here.stop - here.start
            _, column = linear_sum_assignment(np.concatenate([cost[here], np.full((q, q), limit)], axis=1))
            label[here] = np.where(column < len(places), column, -1)
        return np.asarray(label)

    def choice_cost(self, T: Array, places: Array, label: IntArray) -> float:
        """Twice the negative log-probability of the labels (m,), given poses and how often landmarks in view are seen.

        Without it two landmarks always fit the points of one better than one does: each point takes the nearer. Only
        landmarks in view are a choice: many that stand elsewhere make no label less likely.
        """
        return self._chosen(self._candidates(T, places, label), label, self.rates(T, places, label))

    def rates(self, T: Array, places: Array, label: IntArray) -> Array:
        """How often (l,) each landmark is seen where it is in view."""
        count = np.bincount(label[label >= 0], minlength=len(places))
        return np.asarray(count / np.maximum(self._candidates(T, places, label).sum(axis=0), 1))

    def chosen(self, state: State, rate: Array) -> float:
        """The cost of the choice where rates (l,) are known."""
        return self._chosen(self._candidates(state.T, state.places, state.label), state.label, rate)

    def _chosen(self, in_view: BoolArray, label: IntArray, rate: Array) -> float:
        known = label >= 0
        expected = (in_view * rate).sum(axis=1)[self.frames.frame[: len(label)][known]]
        return float(-2.0 * np.log(np.maximum(rate[label[known]], 1e-9) / np.maximum(expected, 1e-9)).sum())

    def _candidates(self, T: Array, places: Array, label: IntArray) -> BoolArray:
        """Which places (n, l) are in view of each frame, or seen."""
        in_view = self._in_view(T, places)
        known = label >= 0
        in_view[self.frames.frame[: len(label)][known], label[known]] = True
        return in_view

    def _in_view(self, T: Array, places: Array) -> BoolArray:
        """Which places (n, l) are in view of each frame."""
        return self.view.holds(np.einsum("nji,nlj->nli", T[:, :3, :3], places[None] - T[:, None, :3, 3]))

    def merge(self, state: State, price: float, n_tries: int = 12) -> State:
        """Try close landmarks that are hardly ever seen together as one; keep what makes the whole likelier."""
        return self.improve(state, self._merged, price, n_tries)

    def improve(self, state: State, trials: Callable[[State], Iterable[Trial]], price: float, n_tries: int) -> State:
        """Take the first of the ``trials`` that makes the whole likelier, and look again, as long as tries last."""
        failed: set[tuple[float, ...]] = set()
        while n_tries > 0:
            better = None
            for trial in trials(state):
                if trial.key in failed or n_tries <= 0:
                    continue
                n_tries -= 1
                settled = self.settle(state.T, trial.label, trial.places, price, 2)
                if settled.cost < state.cost:
                    better = settled
                    break
                failed.add(trial.key)
            if better is None:
                break
            state = better
        return state

    def _merged(self, state: State) -> Iterator[Trial]:
        """Pairs of landmarks as one."""
        for a, b in self._merge_candidates(state):
            yield Trial.of(np.where(state.label == a, b, state.label), state.places, state.places[[a, b]])

    def _merge_candidates(self, state: State) -> list[tuple[int, int]]:
        """Pairs of landmarks (fewer points first), the closest first."""
        n = len(state.places)
        seen = np.zeros((n, len(state.T)))
        used = state.label >= 0
        seen[state.label[used], self.frames.frame[: len(state.label)][used]] = 1.0
        both, count = seen @ seen.T, seen.sum(axis=1)
        distance = np.linalg.norm(state.places[:, None] - state.places[None], axis=-1)
        allowed = both <= np.maximum(1.0, 0.03 * np.minimum(count[:, None], count))
        allowed &= (distance < self.config.merge_reach_m) & np.tri(n, k=-1, dtype=bool)
        pairs = sorted((float(distance[a, b]), int(a), int(b)) for a, b in np.argwhere(allowed))
        return [(a, b) if count[a] <= count[b] else (b, a) for _, a, b in pairs]


def _compact(places: Array, label: IntArray) -> tuple[Array, IntArray]:
    """Places (l, 3) and labels (m,) without the landmarks that fewer than two points support."""
    keep = np.bincount(label[label >= 0], minlength=len(places)) >= 2
    number = np.where(keep, np.cumsum(keep) - 1, -1)
    return places[keep], np.where(label >= 0, number[label], -1) if len(places) else label
