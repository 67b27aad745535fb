"""Following clusters: frames of many stretches at once give what each gives alone, and lost clusters are found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from cluster_slam.association import lanes
from cluster_slam.association.frames import Frames, chi2_and_log_det, sort_by_frame
from cluster_slam.association.lanes import Lanes, assign, near_pairs, pairs_in_lanes, ranges, sums
from cluster_slam.association.lost import Lost
from cluster_slam.association.pose_correction import solve_pose_corrections
from cluster_slam.association.searching import find_lost
from cluster_slam.association.springs import Springs
from cluster_slam.association.templates import Follower
from cluster_slam.association.tracklets import build_tracklets
from cluster_slam.config import TemplateConfig, TrackletConfig
from cluster_slam.geometry import Array, se3_exp, transform
from cluster_slam.records import IntArray
from cluster_slam.simulate import PRESETS, simulate_session

GATE = 16.0


def test_ranges_and_pairs_by_hand() -> None:
    np.testing.assert_array_equal(ranges(np.array([3, 10, 0]), np.array([2, 0, 3])), [3, 4, 0, 1, 2])
    rows, cols = pairs_in_lanes(np.array([0, 1, 1]), np.array([0, 0, 1, 2]), 3)
    np.testing.assert_array_equal(rows, [0, 0, 1, 2])
    np.testing.assert_array_equal(cols, [0, 1, 2, 2])


def test_sums_by_group() -> None:
    values = np.arange(8.0).reshape(4, 2)
    np.testing.assert_array_equal(sums(values, np.array([2, 0, 2, 0]), 4), [[8, 10], [0, 0], [4, 6], [0, 0]])
    np.testing.assert_array_equal(sums(values[:0], np.empty(0, dtype=np.int64), 2), np.zeros((2, 2)))


@pytest.mark.parametrize("pause", [0.0, 1e5])
def test_lanes_cover_every_frame_once_in_both_directions(pause: float) -> None:
    stamps = np.sort(np.random.default_rng(1).uniform(0, 60, 700))
    stamps[300:] += pause
    cut = Lanes.of(stamps, 2.0, both_ways=True)
    assert len(cut.first) > 2
    assert cut.length.sum() < 2 * 2 * 700  # run-ups are shorter than what they prepare
    for way in (1, -1):
        kept = [
            cut.first[a] + k * way for a in np.flatnonzero(cut.way == way) for k in range(cut.run_up[a], cut.length[a])
        ]
        np.testing.assert_array_equal(np.sort(kept), np.arange(700))


def _assign_alone(predicted: Array, P: Array, w: Array, S: Array) -> float:
    """What the best assignment of one frame gains, by the whole table."""
    chi2, _ = chi2_and_log_det(w[None] - predicted[:, None], P[:, None] + S[None])
    gain = np.maximum(GATE - chi2, 0.0)
    return float(gain[linear_sum_assignment(gain, maximize=True)].sum())


@pytest.mark.parametrize("seed", range(5))
def test_assignment_in_lanes_is_the_best_of_each(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lane, point_lane = (np.sort(rng.integers(0, 4, size)) for size in (40, 60))
    predicted, w = rng.uniform(0, 3, (40, 3)), rng.uniform(0, 3, (60, 3))
    P, S = (np.array([np.diag(d) for d in rng.uniform(0.01, 0.1, (n, 3))]) for n in (40, 60))
    near = near_pairs(
        predicted, GATE * np.trace(P, axis1=1, axis2=2), lane, w, GATE * np.trace(S, axis1=1, axis2=2), point_lane, 4
    )
    rows, cols, chi2 = assign(*near, w[near[1]] - predicted[near[0]], P[near[0]] + S[near[1]], GATE, lane)
    assert len(np.unique(rows)) == len(rows) == len(np.unique(cols))
    np.testing.assert_array_equal(lane[rows], point_lane[cols])
    for a in range(4):
        f, p, taken = lane == a, point_lane == a, lane[rows] == a
        np.testing.assert_allclose((GATE - chi2[taken]).sum(), _assign_alone(predicted[f], P[f], w[p], S[p]))


def test_pose_corrections_find_the_error_of_each_frame() -> None:
    rng = np.random.default_rng(3)
    T = se3_exp(rng.normal(0, 0.5, (3, 6)))
    z = rng.normal(0, 1e-4, (3, 6))
    lane = np.repeat([0, 2], 20)
    c = rng.uniform(-1, 1, (40, 3)) + np.array([0.0, 0.0, 2.0])
    residual = transform((T @ se3_exp(z))[lane], c) - transform(T[lane], c)
    found = solve_pose_corrections(
        T[:, :3, :3], lane, c, residual, np.tile(1e-8 * np.eye(3), (40, 1, 1)), 1e-3 * np.eye(6)
    )
    np.testing.assert_allclose(found[[0, 2]], z[[0, 2]], atol=1e-7)
    np.testing.assert_array_equal(found[1], 0.0)


def test_springs_swing_as_the_exact_solution_says() -> None:
    config = TemplateConfig()
    springs = Springs(2, 1, config)
    springs.x[0, 0] = 0.02
    omega, t = 2 * np.pi * config.sway_hz, np.array([0.1, 0.0])
    springs.predict(t)
    np.testing.assert_allclose(springs.x[0, [0, 3]], [0.02 * np.cos(omega * 0.1), -0.02 * omega * np.sin(omega * 0.1)])
    np.testing.assert_array_equal(springs.x[1], 0.0)
    assert np.linalg.eigvalsh(springs.P).min() > 0


def _scene(d: Array, rng: np.random.Generator) -> tuple[Array, IntArray, Array, IntArray]:
    """Two clusters of four flowers in each of two lanes, moved by d (4, 3), with two false detections a lane."""
    places = rng.uniform(0, 0.06, (16, 3))
    cluster = np.repeat(np.arange(4), 4)
    seen = places + d[cluster] + rng.normal(0, 2e-4, (16, 3))
    false = rng.uniform(0, 0.06, (2, 2, 3))
    w = np.concatenate([seen[:8], false[0], seen[8:], false[1]])
    return places, cluster, w, np.repeat([0, 1], 10)


@pytest.mark.parametrize("seed", range(3))
def test_lost_clusters_are_found_where_they_jumped_to(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d = rng.normal(0, 0.012, (4, 3))
    places, cluster, w, point_lane = _scene(d, rng)
    S = np.tile(np.eye(3) * 4e-8, (len(w), 1, 1))
    lost = Lost(
        lane=np.array([0, 0, 1, 1]),
        predicted=np.zeros((4, 3)),
        cov=np.tile(1e-6 * np.eye(3), (4, 1, 1)),
        is_unseen=np.zeros(4, dtype=bool),
    )
    found = find_lost(lost, places, cluster, np.ones(len(w), dtype=bool), w, S, point_lane, TemplateConfig())
    np.testing.assert_allclose(found.d, d, atol=1e-3)
    np.testing.assert_array_equal(cluster[found.flower], found.cluster)
    np.testing.assert_array_equal(point_lane[found.point], lost.lane[found.cluster])
    assert len(np.unique(found.point)) == len(found.point) == 16
    np.testing.assert_allclose(w[found.point], places[found.flower] + d[found.cluster], atol=2e-3)


def test_a_cluster_is_not_found_by_one_flower_alone() -> None:
    places = np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]])
    lost = Lost(np.array([0]), np.zeros((1, 3)), 1e-6 * np.eye(3)[None], np.array([False]))
    w = np.array([[0.01, 0, 0], [0.5, 0.5, 0.5]])
    found = find_lost(
        lost, places, np.zeros(3, dtype=np.int64), np.ones(2, dtype=bool), w, np.tile(1e-7 * np.eye(3), (2, 1, 1)),
        np.zeros(2, dtype=np.int64), TemplateConfig(),
    )  # fmt: skip
    assert not np.isfinite(found.score[0])
    assert len(found.flower) == 0


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Observations from true poses, with the true flower and cluster of each."""

    frames: Frames
    T: Array
    flower: IntArray
    cluster: IntArray


def _followed(frames: Frames, T: Array, places: Array, cluster: IntArray) -> tuple[IntArray, Array]:
    cov = np.diag(np.repeat([2e-3, 1e-3], 3) ** 2)
    forward, backward = Follower(frames, T, cov, places, cluster, 0.5, TemplateConfig()).run()
    return np.stack([forward.landmark, backward.landmark]), np.stack([forward.score, backward.score])


@pytest.fixture(scope="module")
def known() -> Known:
    """A session seen from its true poses."""
    made = simulate_session(PRESETS["moderate"], seed=5)
    session, truth = made.session, made.truth
    assert truth.flower_ids is not None
    assert truth.cluster_ids is not None
    frames = sort_by_frame(session.observations, session.stamps)
    return Known(
        frames, session.poses @ made.hand_eye.true, truth.flower_ids[frames.order], truth.cluster_ids[frames.order]
    )


def test_stretches_give_what_the_whole_gives(known: Known, monkeypatch: pytest.MonkeyPatch) -> None:
    """Followed in stretches, each with its run-up, or in one go: the same landmarks, and mostly the true ones."""
    frames, T, ids = known.frames, known.T, known.flower
    w = transform(T[frames.frame], frames.points)
    seen = np.unique(ids[ids >= 0])
    true = np.where(ids >= 0, np.searchsorted(seen, ids), -1)
    places = np.array([np.median(w[ids == j], axis=0) for j in seen])
    _, cluster = np.unique([known.cluster[ids == j][0] for j in seen], return_inverse=True)
    landmark, score = _followed(frames, T, places, cluster)
    monkeypatch.setattr(lanes, "_STRETCH", 1e9)
    whole, whole_score = _followed(frames, T, places, cluster)
    assert (landmark != whole).mean() < 1e-3
    assert (np.abs(score - whole_score) > 0.1).mean() < 1e-3
    assert (landmark == true).mean() > 0.97


def test_pieces_of_stretches_are_joined(known: Known, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hardly any more pieces than built in one go, as pure, and never two points of one piece in one frame."""
    cov = np.tile(np.diag(np.repeat([2e-3, 1e-3], 3) ** 2), (known.frames.n_frames, 1, 1))
    pieces = build_tracklets(known.frames, known.T, cov, TrackletConfig())
    monkeypatch.setattr(lanes, "_STRETCH", 1e9)
    whole = build_tracklets(known.frames, known.T, cov, TrackletConfig())
    assert pieces.n == int(pieces.labels.max()) + 1
    assert pieces.n < 1.05 * whole.n
    in_frame = np.stack([known.frames.frame, pieces.labels])
    assert np.unique(in_frame, axis=1).shape[1] == len(known.frames)
    assert _purity(pieces.labels, known.flower) > _purity(whole.labels, known.flower) - 0.002


def _purity(label: IntArray, true: IntArray) -> float:
    """Share of points whose piece is mostly of their flower."""
    kinds, count = np.unique(np.stack([label, true]), axis=1, return_counts=True)
    most = np.zeros(int(label.max()) + 1)
    np.maximum.at(most, kinds[0], count)
    return float(most.sum() / len(label))
