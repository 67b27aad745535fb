"""One landmark that is two."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.association.drift_labels import Labelling, State
from cluster_slam.association.drift_smoother import steps_of
from cluster_slam.association.drift_split import split
from cluster_slam.association.frames import sort_by_frame
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, inverse, se3_exp, transform
from cluster_slam.records import IntArray, Observations

_N = 120
_ALONE = np.array([[-2.0, 0.0, 3.5], [2.0, 0.0, 3.5]])  # hold the way in place


def _session(apart: float, sigma: float = 0.03) -> tuple[Labelling, Array, IntArray]:
    """A vehicle that moves to and fro before two landmarks alone and two (or one) at a distance of ``apart`` m."""
    rng = np.random.default_rng(4)
    T = se3_exp(np.outer(0.5 * np.sin(np.arange(_N) / 10.0), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    places = np.concatenate([_ALONE, [[0.0, 0.0, 3.0], [apart, 0.0, 3.0]]])
    frame = np.repeat(np.arange(_N), 3)
    label = np.column_stack([np.zeros(_N), np.ones(_N), 2 + np.arange(_N) % 2]).astype(int).ravel()
    points = transform(inverse(T[frame]), places[label]) + sigma * rng.standard_normal((3 * _N, 3)) * [1, 0, 1]
    covs = np.tile(np.diag([sigma**2, 1e-4, sigma**2]), (3 * _N, 1, 1))
    frames = sort_by_frame(Observations(frame, points, covs, np.full(3 * _N, np.nan)), 0.25 * np.arange(_N))
    cov_step = np.tile(np.diag([1e-6, 0.01, 1e-6, 0.02, 1e-6, 0.02]) ** 2, (_N - 1, 1, 1))
    config = ParticleConfig()
    return Labelling(frames, steps_of(T, cov_step, frames.stamps, config), config), T, label


@pytest.mark.parametrize(("apart", "n"), [(0.0, 3), (0.2, 4)])
def test_a_landmark_is_parted_where_its_points_say_so(apart: float, n: int) -> None:
    labels, T, label = _session(apart)
    one = labels.settle(T, np.minimum(label, 2), np.concatenate([_ALONE, [[apart / 2.0, 0.0, 3.0]]]), 20.0)
    assert len(one.places) == 3
    out = split(labels, one, 20.0)
    assert len(out.places) == n
    if n == 4:
        assert out.cost < one.cost - 100.0
        right = sum(int(np.bincount(out.label[(label == j) & (out.label >= 0)]).max()) for j in range(4))
        assert right >= 0.98 * len(label)


def test_what_is_no_landmark_is_left_alone() -> None:
    labels, T, label = _session(0.2)
    nothing = State(T, np.full(len(label), -1), np.empty((0, 3)), 0.0)
    assert split(labels, nothing, 20.0) is nothing
