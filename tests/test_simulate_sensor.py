"""The simulated camera errs, misses, and sees what is not there, exactly as often as configured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from cluster_slam.geometry import inverse, transform
from cluster_slam.records import CLUTTER
from cluster_slam.simulate import PRESETS, SimulateConfig, Simulated, simulate_session
from cluster_slam.simulate.leaves import Leaves, hidden_by

MODERATE = PRESETS["moderate"]


def _errors(made: Simulated) -> tuple[np.ndarray, np.ndarray]:
    """Errors (k, 3) of the true detections in the camera frame, and their squared Mahalanobis distances (k,)."""
    truth, seen = made.truth, made.session.observations
    assert truth.flower_ids is not None
    assert truth.T_world_camera is not None
    real = truth.flower_ids != CLUTTER
    frame = seen.frame[real]
    world = made.flower_positions[frame, truth.flower_ids[real]]
    error = seen.points[real] - transform(inverse(truth.T_world_camera)[frame], world)
    solved = np.linalg.solve(seen.covs[real], error[..., None])[..., 0]
    return error, (error * solved).sum(1)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("base", ["moderate", "hard"])
def test_nees_of_the_observations_is_that_of_the_stated_sigmas(base: str, factor: float) -> None:
    made = simulate_session(replace(PRESETS[base], stated_sigma_factor=factor, duration_s=30.0), seed=11)
    d2 = _errors(made)[1]
    band = 4 * np.sqrt(2 / (3 * len(d2)))
    assert d2.mean() / 3 * factor**2 == pytest.approx(1.0, abs=band + 0.002)  # 0.002: the depth's own noise in z^2
    if factor == 1.0:
        inside = (d2 < stats.chi2.ppf(0.95, 3)).mean()
        assert inside == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / len(d2)) + 0.001)


def test_depth_noise_grows_with_the_square_of_depth_and_pixel_noise_with_depth() -> None:
    made = simulate_session(replace(PRESETS["hard"], duration_s=30.0, distance_max_m=0.9), seed=1)
    error, _ = _errors(made)
    z = made.session.observations.points[made.truth.flower_ids != CLUTTER, 2]
    ray = made.session.observations.points[made.truth.flower_ids != CLUTTER] / z[:, None]
    sideways = error[:, :2] - error[:, 2:] * ray[:, :2]
    for low, high in ((0.3, 0.5), (0.5, 0.7), (0.7, 1.0)):
        pick = (z > low) & (z < high)
        tolerance = 4 / np.sqrt(2 * pick.sum())
        assert (error[pick, 2] / z[pick] ** 2).std() == pytest.approx(0.006, rel=tolerance)
        assert (sideways[pick] / z[pick, None] * 430.0).std() == pytest.approx(1.0, rel=tolerance)


def test_the_tails_are_as_heavy_and_as_many_as_configured() -> None:
    made = simulate_session(PRESETS["hard-tails"], seed=2)
    d2 = _errors(made)[1]
    assert d2.mean() / 3 == pytest.approx(0.97 + 0.03 * 25, abs=0.06)
    limit = stats.chi2.ppf(0.9999, 3)
    expected = 0.97 * 1e-4 + 0.03 * stats.chi2.sf(limit / 25, 3)
    assert (d2 > limit).mean() == pytest.approx(expected, abs=4 * np.sqrt(expected / len(d2)))


@pytest.mark.parametrize("miss_rate", [0.0, 0.1, 0.3])
def test_the_share_of_misses_is_the_configured_one(miss_rate: float) -> None:
    made = simulate_session(replace(MODERATE, miss_rate=miss_rate, pixel_sigma=0.01), seed=4)
    n = int(made.visible.sum())
    n_seen = int((made.truth.flower_ids != CLUTTER).sum())
    sigma = np.sqrt(miss_rate * (1 - miss_rate) / n)
    assert 1 - n_seen / n == pytest.approx(miss_rate, abs=4 * sigma + 2e-4)  # 2e-4: noise past the image's border
    assert made.visible[made.session.observations.frame, made.truth.flower_ids][
        made.truth.flower_ids != CLUTTER
    ].all()  # nothing hidden or out of view is ever seen


def test_a_leaf_hides_what_lies_behind_it_and_nothing_else() -> None:
    upright = np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])  # axes x and z, normal along y
    leaves = Leaves(np.array([[[0.0, 0.5, 0.0]]]), upright, np.array([[0.1, 0.2]]))
    points = np.array(
        [
            [0.0, 1.0, 0.0],  # straight behind
            [0.19, 1.0, 0.0],  # crosses at x = 0.095: inside of 0.1
            [0.21, 1.0, 0.0],  # at 0.105: beside
            [0.0, 1.0, 0.39],  # at z = 0.195: inside of 0.2
            [0.0, 1.0, 0.41],  # at 0.205: above
            [0.0, 0.4, 0.0],  # in front
            [0.0, -1.0, 0.0],  # behind the eye
            [0.15, 1.0, 0.3],  # 0.75^2 + 0.75^2 > 1: the corner of the box is free
        ]
    )
    hidden = hidden_by(leaves, np.zeros(8, np.int64), np.zeros((8, 3)), points)
    assert hidden.tolist() == [True, True, False, True, False, False, False, False]


def test_leaves_hide_whole_clusters_for_seconds() -> None:
    longest = []
    for seed in range(4):
        with_leaves = simulate_session(PRESETS["hard"], seed=seed)
        without = simulate_session(replace(PRESETS["hard"], n_leaves=0), seed=seed)
        assert not (with_leaves.visible & ~without.visible).any()
        cluster = with_leaves.plant.flower_cluster
        for j in range(40):
            hidden = without.visible[:, cluster == j].all(1) & ~with_leaves.visible[:, cluster == j].any(1)
            steps = np.flatnonzero(np.diff(np.r_[0, hidden, 0]))
            longest.append((steps[1::2] - steps[::2]).max(initial=0) / 30.0)
    assert np.mean(np.array(longest) > 1.0) > 0.3
    assert max(longest) > 3.0


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_clutter_comes_as_often_as_configured(share: float) -> None:
    config = replace(MODERATE, clutter_per_frame=3.0, clutter_persistent_share=share)
    rates = []
    for seed in range(4):
        made = simulate_session(config, seed=seed)
        rates.append((made.truth.flower_ids == CLUTTER).mean() * len(made.session.observations) / 900)
    # a false detection that stays counts up to 8 times, and may leave the view or the end of the session
    sigma = np.sqrt(3.0 * (1 + 5 * share) / (4 * 900))
    assert np.mean(rates) == pytest.approx(3.0, abs=4 * sigma + (0.6 * share + 0.05) * 3.0 * (share > 0) + 0.01)


def test_half_of_the_clutter_is_near_flowers_and_some_of_it_stays() -> None:
    config = replace(MODERATE, clutter_per_frame=3.0)
    made = simulate_session(config, seed=5)
    seen = made.session.observations
    false = made.truth.flower_ids == CLUTTER
    world = transform(made.truth.T_world_camera[seen.frame[false]], seen.points[false])
    gap = np.linalg.norm(world[:, None] - made.flower_positions[seen.frame[false]], axis=2).min(1)
    assert 0.4 < (gap < 0.12).mean() < 0.75
    staying = simulate_session(replace(config, clutter_persistent_share=1.0, n_leaves=0), seed=5)
    seen = staying.session.observations
    false = np.flatnonzero(staying.truth.flower_ids == CLUTTER)
    world = transform(staying.truth.T_world_camera[seen.frame[false]], seen.points[false])
    step = np.linalg.norm(world[:, None] - world, axis=2)
    next_frame = seen.frame[false][None] - seen.frame[false][:, None] == 1
    has_next = np.where(next_frame, step, np.inf).min(1) < 0.015
    assert has_next.mean() == pytest.approx(1 - 1 / 5, abs=0.08)  # a mean life of 5 frames ends once in 5


def test_observations_are_shuffled_within_frames_and_the_frames_in_order() -> None:
    made = simulate_session(MODERATE, seed=6)
    seen, ids = made.session.observations, made.truth.flower_ids
    assert (np.diff(seen.frame) >= 0).all()
    same = np.diff(seen.frame) == 0
    rising = (np.diff(ids) > 0)[same].mean()
    assert rising == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(same.sum()) + 0.01)


def test_scores_tell_something_but_not_all() -> None:
    made = simulate_session(replace(PRESETS["hard"], with_scores=True, duration_s=20.0), seed=0)
    scores, false = made.session.observations.scores, made.truth.flower_ids == CLUTTER
    assert ((scores > 0) & (scores < 1)).all()
    better = (scores[~false][:, None][::20] > scores[false]).mean()
    assert 0.75 < better < 0.97


def test_without_covariances_the_stated_sigma_is_the_rms_of_the_errors() -> None:
    made = simulate_session(PRESETS["moderate-bare"], seed=3)
    assert not made.session.observations.has_covariance
    error, _ = _errors(made)
    assert made.session.noise.flower == pytest.approx(np.sqrt((error**2).mean()), rel=0.1)
    np.testing.assert_array_equal(made.session.observations.covs[0], made.session.noise.flower**2 * np.eye(3))


def test_the_stated_noise_is_the_true_one_times_the_factor() -> None:
    plain = simulate_session(replace(MODERATE, duration_s=1.0), seed=3).session.noise
    double = simulate_session(replace(MODERATE, duration_s=1.0, stated_sigma_factor=2.0), seed=3).session.noise
    assert (plain.pose_translation, plain.pose_rotation) == (0.001, 0.002)
    assert (plain.hand_eye_translation, plain.pixel, plain.depth) == (0.004, 1.0, 0.006)
    for name in ("pose_translation", "pose_rotation", "hand_eye_translation", "hand_eye_rotation", "pixel", "depth"):
        assert getattr(double, name) == pytest.approx(2 * getattr(plain, name))


def _reachable(config: SimulateConfig) -> tuple[float, float]:
    made = simulate_session(config, seed=9)
    return len(made.session.observations) / made.session.n_frames, float(made.visible.mean())


@pytest.mark.parametrize(("name", "per_frame"), [("moderate", 20.0), ("hard", 52.0)])
def test_a_frame_sees_part_of_the_plant(name: str, per_frame: float) -> None:
    rate, share = _reachable(PRESETS[name])
    assert 0.55 * per_frame < rate < 1.5 * per_frame
    assert 0.2 < share < 0.65
