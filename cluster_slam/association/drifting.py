"""Association where poses drift: the map grows stretch by stretch, all is smoothed after each, decisions are undone.

Dead reckoning cannot be trusted for longer than a few seconds, so points are compared with landmarks from an
*estimated* pose. First the instruments' own errors are taken out. What lies between two gaps is then mapped for
itself, stretch by stretch, with particles: after each stretch all poses and places so far are smoothed, all points are
associated again, and landmarks are merged where that makes the whole likelier, each landmark having a price. These
maps are joined, the largest first: several motions in the gap are tried, and the likeliest whole is kept. In the end
every stretch is associated once more, with the map that the others make.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.calibration import Calibration, calibrate, delayed
from cluster_slam.association.drift_labels import Labelling, State, choice_cost
from cluster_slam.association.drift_smoother import DriftSmoother, Steps, steps_of
from cluster_slam.association.frames import Frames
from cluster_slam.association.particles import trace_stretch
from cluster_slam.association.submaps import Part, joined, matched, motions, spans_between_gaps, window
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.records import IntArray

_GAP = 5.0  # usual steps; what is longer is a gap, in which nothing was seen


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """Camera poses (n, 4, 4), landmark of each point (m,) or -1, places (l, 3), covariances (n - 1, 6, 6) of the steps.

    The covariances are the given ones as the session has shown them: larger where odometry slipped. ``cost`` is twice
    the negative log-likelihood with the landmarks' price. All holds for frames and poses as ``instruments`` correct
    them.
    """

    T: Array
    label: IntArray
    places: Array
    cov_step: Array
    cost: float
    instruments: Calibration


def needs_tracing(frames: Frames, given: Array, cov_step: Array) -> bool:
    """Whether poses (n, 4, 4) drift too far, and frames hold too few points, for an association by the given poses.

    Where frames hold more points than their pose has unknowns, pieces correct the drift by themselves; and drift that
    stays below the noise of the points does no harm.
    """
    if frames.n_frames < 3 or len(frames) < frames.n_frames:
        return False
    range_sq = float(np.median((frames.points**2).sum(axis=1)))
    total = cov_step.sum(axis=0)
    drift_sq = np.trace(total[3:, 3:]) + np.trace(total[:3, :3]) * range_sq
    noise_sq = float(np.median(np.trace(frames.covs, axis1=1, axis2=2)))
    return bool(drift_sq > 9.0 * noise_sq and len(frames) < 6 * frames.n_frames)


def trace_drifting(
    frames: Frames, given: Array, cov_step: Array, config: ParticleConfig, *, rng: np.random.Generator
) -> Traced:
    """Poses and association of a session whose poses drift.

    Parameters
    ----------
    frames : Frames
    given : (n, 4, 4) camera poses by odometry; the first defines the world.
    cov_step : (n - 1, 6, 6) of each step, tangent at its end.
    config : options.
    rng : for the particles.
    """
    calibration = calibrate(frames, given, config)
    late = delayed(given, frames.stamps, calibration.lag_s)
    steps = steps_of(late, cov_step, frames.stamps, config)
    rough = _Tracer(calibration.without_growth().correct(frames), late, steps, config, rng)  # it takes wrong turns less
    start = rough.price(rough.assemble())
    seen = calibration.correct(frames)
    tracer = _Tracer(seen, late, steps, config, rng)
    best = _anchored(tracer.redo(tracer.price(start)), given[0])
    weights = DriftSmoother(seen, steps, config.point_dof).step_weights(best.T)
    scaled = cov_step * (config.odometry_scale**2 / weights)[:, None, None]
    return Traced(best.T, best.label, best.places, scaled, best.cost, calibration)


def _anchored(state: State, first: Array) -> State:
    """The same with the first pose (4, 4) where it defines the world."""
    home = first @ inverse(state.T[0])
    return State(home @ state.T, state.label, transform(home, state.places), state.cost)


class _Tracer:
    """One pass through a session."""

    def __init__(
        self, frames: Frames, given: Array, steps: Steps, config: ParticleConfig, rng: np.random.Generator
    ) -> None:
        self.frames, self.given, self.steps, self.config, self.rng = frames, given, steps, config, rng
        self.labels = Labelling(frames, steps, config)

    def assemble(self) -> State:
        """Map what lies between gaps for itself, then join the parts: the largest, then what joins most clearly."""
        spans = spans_between_gaps(self.steps, self.frames.n_frames, self.config.gap_steps)
        parts = [self._part(*span) for span in spans]
        low = high = int(np.argmax([part.weight for part in parts]))
        whole = parts[low]
        if whole.weight == 0:
            return self.grow()
        while low > 0 or high + 1 < len(parts):
            sides = [k for k in (low - 1, high + 1) if 0 <= k < len(parts)]
            ranked = [self._join(whole, parts[k]) for k in sides]
            clearest = int(np.argmax([share for _, share in ranked]))
            whole = ranked[clearest][0]
            low, high = min(low, sides[clearest]), max(high, sides[clearest])
        return State(whole.T, whole.label, whole.places, 0.0)

    def _window(self, first: int, end: int) -> _Tracer:
        """The same for a part of the session."""
        frames, steps = window(self.frames, first, end), self.steps.between(first, end)
        return _Tracer(frames, self.given[first:end], steps, self.config, self.rng)

    def _part(self, first: int, end: int) -> Part:
        """What was seen between two gaps; where that is little, it waits for a map of its surroundings."""
        tracer = self._window(first, end)
        n = len(tracer.frames)
        if n < self.config.fewest_points:
            return tracer.as_part(State(self.given[first:end], np.full(n, -1), np.empty((0, 3)), 0.0), first)
        return tracer.as_part(tracer.grow(), first)

    def as_part(self, state: State, first: int) -> Part:
        """A state as a part of a session, whose first frame it is."""
        var = self._covs(state)[:, 0, 0] * self.config.submap_slack**2
        return Part(first, first + len(state.T), state.T, state.label, state.places, var, self.frames.frame)

    def _join(self, a: Part, b: Part) -> tuple[Part, float]:
        """Both parts as one, and the share of the points of b that landmarks of a explain."""
        if len(b.places) == 0:
            return joined(a, b, np.zeros(self.steps.basis.shape[1]), self.steps), 1.0
        tracer = self._window(min(a.first, b.first), max(a.end, b.end))
        price = self.config.growing_cost
        tries = []
        for z in motions(a, b, self.steps, self.config.n_motions):
            trial = matched(joined(a, b, z, self.steps), len(a.places))
            tries.append(tracer.labels.settle(trial.T, trial.label, trial.places, price, 1))
        tries.sort(key=lambda state: state.cost)
        best = tracer.labels.merge(tries[0], price)
        own = np.isin(tracer.frames.order, self._window(b.first, b.end).frames.order)
        known = np.unique(best.label[np.logical_not(own)])
        share = float(np.isin(best.label[own], known[known >= 0]).mean())
        return tracer.as_part(best, min(a.first, b.first)), share

    def grow(self) -> State:
        """Go through the session, stretch by stretch."""
        n, starts, config = self.frames.n_frames, self.frames.starts, self.config
        state = State(np.empty((0, 4, 4)), np.empty(0, dtype=np.int64), np.empty((0, 3)), 0.0)
        done = 0
        while done < n:
            end = min(max(done + 1, int(np.searchsorted(starts, starts[done] + config.stretch_points))), n)
            ahead = min(int(np.searchsorted(starts, starts[end] + config.ahead_points)), n)
            if n - end < 10:
                end = ahead = n
            after_gap = done == 0 or bool((self.steps.length[done - 1 : ahead - 1] > _GAP).any())
            if after_gap:
                end = ahead
            tries = [
                self._extend(state, done, end, ahead, after_gap) for _ in range(config.n_tries if after_gap else 1)
            ]
            state = min(tries, key=lambda s: s.cost)
            done = end
        return state

    def _extend(self, state: State, done: int, end: int, ahead: int, after_gap: bool) -> State:
        """Associate the frames from ``done`` to ``end`` and smooth all so far."""
        found = trace_stretch(
            self.frames,
            self.steps,
            (done, ahead),
            state.T[-1] if done else self.given[0],
            state.places,
            self._covs(state),
            self.config.n_particles * (2 if after_gap else 1),
            self.config,
            rng=self.rng,
        )
        n_points = int(self.frames.starts[end] - self.frames.starts[done])
        T = np.concatenate([state.T, found.T[: end - done]])
        label = np.concatenate([state.label, found.label[:n_points]])
        price = self.config.growing_cost
        return self.labels.merge(self.labels.settle(T, label, found.places, price), price)

    def price(self, state: State) -> State:
        """The same with the final price of landmarks, which merges more of them."""
        price = self.config.landmark_cost
        return self.labels.merge(self.labels.settle(state.T, state.label, state.places, price), price, 40)

    def redo(self, state: State) -> State:
        """Associate every stretch again, with the landmarks that the others support, as long as that helps."""
        price = self.config.landmark_cost
        for _ in range(self.config.n_redo):
            new = state
            for span in self._spans():
                new = self._redo_span(new, span, price)
            new = self.labels.merge(self.labels.settle(new.T, new.label, new.places, price), price)
            if new.cost >= state.cost - 1.0:
                break
            state = new
        return state

    def _spans(self) -> list[tuple[int, int]]:
        """Frames with ``stretch_points`` points each, every two neighbours overlapping by half."""
        m, half = len(self.frames), self.config.stretch_points // 2
        bounds = [*self.frames.frame[0 : max(m - half, 1) : half].tolist(), self.frames.n_frames]
        bounds = sorted({0, *bounds})
        return list(zip(bounds[:-2], bounds[2:], strict=True)) or [(0, self.frames.n_frames)]

    def _redo_span(self, state: State, span: tuple[int, int], price: float) -> State:
        """Associate the frames of a span again, if that is likelier there, the rest of the session standing still."""
        a, b = span
        first, end = max(0, a - (b - a) // 2), min(self.frames.n_frames, b + (b - a) // 2)
        around = slice(int(self.frames.starts[first]), int(self.frames.starts[end]))
        inside = slice(int(self.frames.starts[a]) - around.start, int(self.frames.starts[b]) - around.start)
        elsewhere = state.label.copy()
        elsewhere[around] = -1
        covs = self._covs(State(state.T, elsewhere, state.places, 0.0))
        part = self._window(first, end)
        smoother = DriftSmoother(part.frames, part.steps, self.config.point_dof, state.places, 1.0 / covs[:, 0, 0])
        old = part.local(smoother, state.T[first:end], state.label[around], state.places)
        start = state.T[max(a - 1, 0)]
        found = trace_stretch(
            part.frames,
            part.steps,
            (a - first, b - first),
            start,
            state.places,
            covs,
            self.config.n_particles,
            self.config,
            rng=self.rng,
        )
        T, label = state.T[first:end].copy(), state.label[around].copy()
        T[a - first : b - first], label[inside] = found.T, found.label
        new = part.local(smoother, T, label, found.places, inside)
        n_new = len(np.unique(new.label[new.label >= len(state.places)]))
        T, label = state.T.copy(), state.label.copy()
        T[first:end], label[around] = new.T, new.label
        before = state.label.copy()
        before[around] = old.label
        if new.cost + price * n_new + choice_cost(label) >= old.cost + choice_cost(before) - 1e-6:
            return state
        return State(T, label, np.concatenate([state.places, new.places[len(state.places) :]]), np.inf)

    def local(
        self, smoother: DriftSmoother, T: Array, label: IntArray, places: Array, again: slice | None = None
    ) -> State:
        """Smoothed with places that others hold; the points ``again`` are associated once more."""
        T, places = smoother.solve(T, places, label)
        if again is not None:
            label = label.copy()
            label[again] = self.labels.associate(smoother, T, places)[again]
            T, places = smoother.solve(T, places, label)
        clutter = self.config.clutter_cost * int((label < 0).sum())
        return State(T, label, places, smoother.cost(T, places, label) + clutter)

    def _covs(self, state: State) -> Array:
        """How well places are known (l, 3, 3) relative to the latest pose: noise that repeats, and that does not."""
        noise_sq = float(np.median(np.trace(self.frames.covs, axis1=1, axis2=2)))
        count = np.bincount(state.label[state.label >= 0], minlength=len(state.places))
        var = noise_sq * (0.06 + 2.5 / np.maximum(count, 1))
        return np.asarray(var[:, None, None] * np.eye(3))
