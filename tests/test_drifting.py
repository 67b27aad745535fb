"""Association where poses drift: a vehicle on a floor among landmarks that look alike."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.association.drift_joining import assemble
from cluster_slam.association.drift_labels import Labelling, View
from cluster_slam.association.drift_session import DriftSession
from cluster_slam.association.drift_smoother import DriftSmoother, steps_of
from cluster_slam.association.drifting import drifts_far, frames_tell_poses, trace_drifting
from cluster_slam.association.frames import Frames, sort_by_frame
from cluster_slam.config import ParticleConfig
from cluster_slam.evaluation.trajectory import absolute_error
from cluster_slam.geometry import Array, inverse, se3_exp, transform
from cluster_slam.records import IntArray, Observations

_PLACES = np.array([[2.0, 0, 3.0], [2.3, 0, 3.0], [-2.0, 0, 3.0], [0.0, 0, -3.0], [3.0, 0, -1.0], [-3.0, 0, -1.0]])
_SIGMA = 0.03
_STEP = np.array([1e-7, 0.04, 1e-7, 0.01, 1e-7, 0.01])  # rad and m: a plane, y is its normal


class _World:
    """Truth, odometry and points of a vehicle that drives circles among six landmarks."""

    def __init__(self, seed: int, n: int = 160) -> None:
        rng = np.random.default_rng(seed)
        step = se3_exp(np.array([0, 2 * np.pi / 60, 0, 0, 0, 0.08]))
        self.true = np.empty((n, 4, 4))
        self.true[0] = np.eye(4)
        self.given = self.true.copy()
        for i in range(1, n):
            self.true[i] = self.true[i - 1] @ step
            self.given[i] = self.given[i - 1] @ step @ se3_exp(_STEP * rng.standard_normal(6))
        self.cov_step = np.tile(np.diag(_STEP**2), (n - 1, 1, 1))
        self.frames, self.label = self._look(rng)

    def _look(self, rng: np.random.Generator) -> tuple[Frames, IntArray]:
        seen = transform(inverse(self.true)[:, None], np.broadcast_to(_PLACES, (len(self.true), *_PLACES.shape)))
        visible = (seen[..., 2] > 0.3) & (np.abs(seen[..., 0]) < seen[..., 2])
        frame, label = np.nonzero(visible)
        noise = _SIGMA * rng.standard_normal((len(frame), 3)) * [1, 0, 1]
        covs = np.tile(np.diag([_SIGMA**2, 1e-4, _SIGMA**2]), (len(frame), 1, 1))
        observations = Observations(frame, seen[visible] + noise, covs, np.full(len(frame), np.nan))
        return sort_by_frame(observations, 0.25 * np.arange(len(self.true))), label


def _error(T: Array, true: Array) -> float:
    return absolute_error(T, true).position_m


@pytest.fixture(scope="module")
def world() -> _World:
    return _World(1)


def test_true_association_is_a_fixed_point_of_smoothing(world: _World) -> None:
    config = ParticleConfig(odometry_scale=1.0)
    steps = steps_of(world.given, world.cov_step, world.frames.stamps, config)
    assert steps.basis.shape == (6, 3)  # a plane leaves three motions
    smoother = DriftSmoother(world.frames, steps, config.point_dof)
    T, places = smoother.solve(world.given, _PLACES, world.label, 30, 1e-9)
    again, places_again = smoother.solve(T, places, world.label, 1)
    assert np.abs(again - T).max() < 1e-6
    assert np.abs(places_again - places).max() < 1e-6
    assert smoother.cost(T, places, world.label) < smoother.cost(world.true, _PLACES, world.label)
    assert _error(T, world.true) < 0.3 * _error(world.given, world.true)


def test_gradient_vanishes_at_the_solution(world: _World) -> None:
    """The cost does not fall in any direction of any pose or place: its derivative, taken by differences, is zero."""
    config = ParticleConfig()
    smoother = DriftSmoother(
        world.frames, steps_of(world.given, world.cov_step, world.frames.stamps, config), config.point_dof
    )
    T, places = smoother.solve(world.given, _PLACES, world.label, 60, 1e-10)
    h = 1e-4
    for frame, axis in ((5, 1), (40, 3), (90, 5), (159, 1)):
        costs = []
        for sign in (1, -1):
            moved = T.copy()
            moved[frame] = T[frame] @ se3_exp(sign * h * np.eye(6)[axis])
            costs.append(smoother.cost(moved, places, world.label))
        curvature = (sum(costs) - 2.0 * smoother.cost(T, places, world.label)) / h**2
        assert abs(costs[0] - costs[1]) / (2.0 * h) < 1e-3 * curvature  # within a thousandth of a Newton step, m or rad


@pytest.mark.parametrize("seed", [1, 2])
def test_every_landmark_once_and_the_way_found(seed: int) -> None:
    world = _World(seed)
    assert drifts_far(world.frames, world.given, world.cov_step)
    assert not frames_tell_poses(world.frames)
    traced = trace_drifting(
        world.frames, world.given, world.cov_step, ParticleConfig(n_particles=60), rng=np.random.default_rng(0)
    )
    assert len(traced.places) == len(_PLACES)
    pairs = np.unique(np.column_stack([traced.label, world.label])[traced.label >= 0], axis=0, return_counts=True)
    right = sum(int(pairs[1][pairs[0][:, 1] == j].max()) for j in range(len(_PLACES)))
    assert right >= 0.98 * len(world.label)
    assert _error(traced.T, world.true) < 0.35 * _error(world.given, world.true)
    np.testing.assert_allclose(traced.T[0], world.given[0], atol=1e-6)


def test_poses_that_hardly_drift_are_kept(world: _World) -> None:
    assert not drifts_far(world.frames, world.given, 1e-4 * world.cov_step)


def _standing(places: Array, n: int) -> tuple[Labelling, Array]:
    """A vehicle that stands still and sees one point a frame; its poses (n, 4, 4)."""
    points = np.tile([0.0, 0.0, 3.0], (n, 1))
    observations = Observations(np.arange(n), points, np.tile(1e-4 * np.eye(3), (n, 1, 1)), np.full(n, np.nan))
    frames, T = sort_by_frame(observations, 0.25 * np.arange(n)), np.tile(np.eye(4), (n, 1, 1))
    config = ParticleConfig()
    steps = steps_of(T, np.tile(np.diag(_STEP**2), (n - 1, 1, 1)), frames.stamps, config)
    view = View.of(np.array([[-1.0, -0.1, 3.0], [1.0, 0.1, 3.0]]))
    return Labelling(frames, steps, config, view), T


def test_choice_between_landmarks_costs_what_it_tells() -> None:
    places = np.array([[0.0, 0.0, 3.0], [0.2, 0.0, 3.0]])
    labels, T = _standing(places, 48)
    assert labels.choice_cost(T, places, np.zeros(48, dtype=np.int64)) == 0.0
    half = np.array([0, 1] * 20 + [-1] * 8)
    assert labels.choice_cost(T, places, half) == pytest.approx(2.0 * 40 * np.log(2.0))
    three_to_one = np.array([0, 0, 0, 1] + [-1] * 44)
    assert labels.choice_cost(T, places, three_to_one) == pytest.approx(2.0 * (3 * np.log(4.0 / 3.0) + np.log(4.0)))


def test_landmarks_out_of_view_are_no_choice() -> None:
    """Where a landmark can be seen, others that stand behind the vehicle make it no less likely."""
    places = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]])
    labels, T = _standing(places, 40)
    T = T.copy()
    T[20:, [0, 2], [0, 2]] = -1.0  # about y by half a turn
    label = np.repeat([0, 1], 20)
    assert labels.choice_cost(T, places, label) == pytest.approx(0.0, abs=1e-9)


def test_one_landmark_split_in_two_is_put_together(world: _World) -> None:
    """Each half takes the points on its side, which fits better than one place does; but the choice tells nothing."""
    config = ParticleConfig()
    steps = steps_of(world.given, world.cov_step, world.frames.stamps, config)
    smoother = DriftSmoother(world.frames, steps, config.point_dof)
    T, places = smoother.solve(world.given, _PLACES, world.label, 30)
    error = transform(T[world.frames.frame], world.frames.points) - places[world.label]
    label = np.where((world.label == 0) & (error[:, 0] > 0), len(places), world.label)
    labels = Labelling(world.frames, steps, config)
    price = config.landmark_cost
    split = labels.settle(T, label, np.concatenate([places, places[:1]]), price)
    merged = labels.merge(split, price)
    assert len(split.places) == len(_PLACES) + 1
    assert len(merged.places) == len(_PLACES)
    assert merged.cost < split.cost


def test_several_wholes_are_carried_over_a_gap() -> None:
    """Half of the way unseen in its middle: both parts are mapped and joined, and every landmark is there once."""
    world = _World(4, 200)
    kept = (world.frames.stamps < 20.0) | (world.frames.stamps > 28.0)
    rows = kept[world.frames.frame]
    number = np.cumsum(kept) - 1
    observations = Observations(
        number[world.frames.frame[rows]],
        world.frames.points[rows],
        world.frames.covs[rows],
        np.full(int(rows.sum()), np.nan),
    )
    frames = sort_by_frame(observations, world.frames.stamps[kept])
    config = ParticleConfig(n_particles=30, n_maps=2, n_motions=8, n_ways=4)
    gaps = np.diff(np.flatnonzero(kept))[:, None, None]
    steps = steps_of(world.given[kept], world.cov_step[0] * gaps, frames.stamps, config)
    session = DriftSession(frames, world.given[kept], steps, config, np.random.default_rng(0), View.of(frames.points))
    wholes = assemble(session)
    assert 1 <= len(wholes) <= config.n_wholes
    assert wholes[0].cost == min(whole.cost for whole in wholes)
    best = wholes[0]
    assert len(best.T) == frames.n_frames
    truth = world.label[rows]
    right = sum(int(np.bincount(best.label[(truth == j) & (best.label >= 0)]).max()) for j in range(len(_PLACES)))
    assert len(best.places) == len(_PLACES)
    assert right >= 0.97 * len(truth)
