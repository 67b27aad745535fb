"""Association where poses drift: a vehicle on a floor among landmarks that look alike."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.association.drift_labels import Labelling, choice_cost
from cluster_slam.association.drift_smoother import DriftSmoother, steps_of
from cluster_slam.association.drifting import needs_tracing, trace_drifting
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
    assert needs_tracing(world.frames, world.given, world.cov_step)
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
    assert not needs_tracing(world.frames, world.given, 1e-4 * world.cov_step)


def test_choice_between_landmarks_costs_what_it_tells() -> None:
    assert choice_cost(np.zeros(50, dtype=np.int64)) == 0.0
    assert choice_cost(np.array([0, 1] * 20 + [-1] * 7)) == pytest.approx(2.0 * 40 * np.log(2.0))
    three_to_one = 2.0 * (3 * np.log(4.0 / 3.0) + np.log(4.0))
    assert choice_cost(np.array([2, 2, 2, 5])) == pytest.approx(three_to_one)


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
