"""The mounting of the camera: closed form, refinement, covariance, boards, advice."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cluster_slam.cli.app import run
from cluster_slam.errors import ConfigError, EstimationError, InputError
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, transform, tum_from_pose
from cluster_slam.graph.calibration import StillPoints, larger, motion_pairs, no_worse, park_martin, refine_mounting
from cluster_slam.pipeline.calibrate import calibrate
from cluster_slam.pipeline.calibrate_board import parse_board
from cluster_slam.sensors.interpolation import interpolate
from cluster_slam.simulate import Simulated, simulate_session
from cluster_slam.simulate.config import MODERATE

X_TRUE = se3_exp(np.array([0.1, -0.2, 1.5, 0.03, -0.05, 0.04]))


def flange_path(n: int, rng: np.random.Generator) -> Array:
    """A smooth path (n, 4, 4) that turns about all axes."""
    t = np.linspace(0.0, 2.0 * np.pi, n)[:, None]
    phase, rate = rng.uniform(0, 6, 6), rng.uniform(1.0, 3.0, 6)
    return se3_exp(np.sin(rate * t + phase) * [0.4, 0.4, 0.4, 0.2, 0.2, 0.2])


def still_points(
    n_frames: int, noise: float, rng: np.random.Generator, offset: float = 0.0, scale: float = 1.0
) -> StillPoints:
    stamps = np.linspace(0.0, 10.0, n_frames)
    poses = flange_path(n_frames, rng)
    places = rng.uniform([-0.2, -0.2, 0.4], [0.2, 0.2, 0.8], (10, 3))
    seen_from = interpolate(stamps, poses, stamps + offset)
    frame, label = (a.ravel() for a in np.meshgrid(np.arange(n_frames), np.arange(10), indexing="ij"))
    points = transform(inverse(seen_from[frame] @ X_TRUE), places[label]) / scale
    points = points + rng.normal(0.0, noise, points.shape)

    def flange_at(tau: float) -> Array:
        return interpolate(stamps, poses, stamps + tau)[frame]

    return StillPoints(flange_at, points, np.full(len(points), noise**2), label, stamps[frame])


def test_park_and_martin_are_exact_without_noise() -> None:
    rng = np.random.default_rng(0)
    flange = flange_path(30, rng)
    camera = flange @ X_TRUE
    pairs = motion_pairs(flange)
    A = inverse(flange[pairs[:, 0]]) @ flange[pairs[:, 1]]
    B = inverse(camera[pairs[:, 0]]) @ camera[pairs[:, 1]]
    np.testing.assert_allclose(park_martin(A, B), X_TRUE, atol=1e-9)


def test_turning_about_one_axis_is_refused() -> None:
    A = se3_exp(np.linspace(0.1, 1.0, 10)[:, None] * [0.0, 0.0, 1.0, 0.1, 0.0, 0.0])
    B = inverse(X_TRUE) @ A @ X_TRUE
    with pytest.raises(EstimationError, match="fewer than two axes"):
        park_martin(A, B)


def test_offset_of_the_clocks_and_depth_scale_are_found() -> None:
    seen = still_points(200, 0.001, np.random.default_rng(1), offset=0.03, scale=1.02)
    found = refine_mounting(
        seen, X_TRUE @ se3_exp(np.full(6, 0.02)), 0.01 * np.eye(6), time_sigma_s=0.1, scale_sigma=0.05
    )
    sigma = np.sqrt(np.diag(found.cov))
    assert found.time_offset_s == pytest.approx(0.03, abs=4.0 * sigma[6])
    assert found.depth_scale == pytest.approx(1.02, abs=4.0 * sigma[7])
    assert sigma[6] < 2e-3
    assert sigma[7] < 2e-3


def test_covariance_of_the_mounting_is_true() -> None:
    """NEES over 40 draws of independent errors; the sandwich may be larger than the truth, never smaller."""
    nees = []
    for seed in range(40):
        seen = still_points(100, 0.002, np.random.default_rng(seed))
        found = refine_mounting(seen, X_TRUE, np.eye(6))
        xi = se3_log(inverse(found.X) @ X_TRUE)
        nees.append(xi @ np.linalg.solve(found.cov, xi) / 6.0)
    assert 0.4 < np.mean(nees) < 1.15


def test_errors_that_last_for_a_second_are_in_the_covariance() -> None:
    """All points of a second are off by the same 3 mm: far more than as many independent ones would leave."""
    nees, naive = [], []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        seen = still_points(100, 0.001, rng)
        off = rng.normal(0.0, 0.003, (10, 3))[np.minimum(seen.stamps, 9.99).astype(int)]
        found = refine_mounting(replace(seen, points=seen.points + off), X_TRUE, np.eye(6))
        xi = se3_log(inverse(found.X) @ X_TRUE)
        nees.append(xi @ np.linalg.solve(found.cov, xi) / 6.0)
        alone = refine_mounting(seen, X_TRUE, np.eye(6)).cov
        naive.append(xi @ np.linalg.solve(alone, xi) / 6.0)
    assert np.mean(naive) > 2.0 * np.mean(nees)  # what independent errors would claim
    assert 0.2 < np.median(nees) * 6.0 / 5.35 < 1.6  # ten stretches tell six parameters' covariance roughly only


def test_the_larger_of_two_covariances_holds_both() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        a, b = (m @ m.T + 0.1 * np.eye(6) for m in rng.normal(size=(2, 6, 6)))
        both = larger(a, b)
        assert np.linalg.eigvalsh(both - b)[0] > -1e-9
        assert np.linalg.eigvalsh(both - a)[0] > -1e-9
    np.testing.assert_allclose(larger(0.5 * np.eye(3), np.eye(3)), np.eye(3))


def test_no_session_makes_worse_what_was_known() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        a, b = (m @ m.T + 0.1 * np.eye(6) for m in rng.normal(size=(2, 6, 6)))
        both = no_worse(a, np.linalg.solve(b, np.eye(6)))
        assert np.linalg.eigvalsh(b - both)[0] > -1e-9
        assert np.linalg.eigvalsh(a - both)[0] > -1e-9
    np.testing.assert_allclose(no_worse(0.5 * np.eye(3), np.eye(3)), 0.5 * np.eye(3))


def test_an_arm_that_turns_about_one_axis_is_told_which_are_missing() -> None:
    made = simulate_session(replace(MODERATE, duration_s=3.0, fps=10.0), seed=5)
    turns = np.zeros((made.session.n_frames, 6))
    turns[:, 1] = 0.3 * np.sin(np.linspace(0.0, 6.0, made.session.n_frames))
    swung = made.session.poses[0] @ se3_exp(turns)
    X = made.hand_eye.true
    true = np.asarray(made.truth.T_world_camera)
    o = made.session.observations
    moved = inverse(swung @ X)[o.frame] @ true[o.frame]
    points = (moved[:, :3, :3] @ o.points[..., None])[..., 0] + moved[:, :3, 3]
    found = calibrate(replace(made.session, poses=swung, observations=replace(o, points=points)))
    assert found.status == "poor"
    assert sum("turn the flange about its" in words for words in found.advice) == 2
    xi = se3_log(inverse(found.mounting.X) @ X)
    assert xi @ np.linalg.solve(found.mounting.cov, xi) < 30.0


def _scatter_m(made: Simulated, X: Array) -> float:
    """Median distance of true observations from their flowers' medians, under that mounting."""
    ids, o = made.truth.flower_ids, made.session.observations
    assert ids is not None
    where = transform((made.session.poses @ X)[o.frame], o.points)
    away = [
        np.linalg.norm(where[ids == i] - np.median(where[ids == i], axis=0), axis=1) for i in np.unique(ids[ids >= 0])
    ]
    return float(np.median(np.concatenate(away)))


def test_flowers_calibrate_their_camera(tmp_path: Path) -> None:
    made = simulate_session(replace(MODERATE, duration_s=8.0, fps=10.0), seed=3)
    found = calibrate(made.session)
    xi = se3_log(inverse(found.mounting.X) @ made.hand_eye.true)
    assert np.linalg.norm(xi[3:]) < 0.002
    assert np.linalg.norm(xi[:3]) < 0.003
    assert xi @ np.linalg.solve(found.mounting.cov, xi) / 6.0 < 3.0
    assert found.status == "ok"
    assert found.mounting.scatter_m == pytest.approx(_scatter_m(made, found.mounting.X), rel=0.05)


def test_poses_of_the_camera_cannot_be_calibrated() -> None:
    made = simulate_session(replace(MODERATE, duration_s=0.5, fps=10.0, pose_frame="T_world_camera"), seed=1)
    with pytest.raises(InputError, match="expected poses of the flange"):
        calibrate(made.session)


def test_an_arm_that_does_not_move_is_told() -> None:
    made = simulate_session(replace(MODERATE, duration_s=1.0, fps=10.0), seed=1)
    n = made.session.n_frames
    still = replace(made.session, poses=np.tile(made.session.poses[0], (n, 1, 1)))
    found = calibrate(still)
    assert found.status == "poor"
    assert any("did not turn" in w for w in found.warnings)
    assert len(found.advice) >= 3


# --- boards


@pytest.mark.parametrize(
    "text", ["charuco:7x5:0.04:0.05:4X4_50", "charuco:7:0.04:0.03:4X4_50", "chess:7x5", "apriltag:99h9:0.1"]
)
def test_boards_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected charuco"):
        parse_board(text)


def board_session(folder: Path, n: int, spread: float) -> None:
    """Pictures of a ChArUco board from many sides, by homography, and the flange's poses with small errors."""
    import cv2
    from cv2 import aruco

    rng = np.random.default_rng(1)
    board = aruco.CharucoBoard((7, 5), 0.04, 0.03, aruco.getPredefinedDictionary(aruco.DICT_4X4_50))
    drawn = board.generateImage((1400, 1000), marginSize=0)
    K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
    T_world_board = se3_exp(np.array([2.9, 0.1, 0, 0.0, 0.5, 0.3]))
    poses, names = [], []
    for k in range(n):
        T = se3_exp(np.concatenate([rng.uniform(-spread, spread, 3), np.zeros(3)]))
        T[:3, 3] = [rng.uniform(-0.04, 0.04), rng.uniform(-0.04, 0.04), rng.uniform(0.4, 0.5)] - T[:3, :3] @ [
            0.14,
            0.1,
            0,
        ]
        half = np.array([[0.28 / 1400, 0, 0.5 * 0.28 / 1400], [0, 0.2 / 1000, 0.5 * 0.2 / 1000], [0, 0, 1]])
        H = K @ np.column_stack([T[:3, 0], T[:3, 1], T[:3, 3]]) @ half
        picture = cv2.warpPerspective(drawn, H, (640, 480), flags=cv2.INTER_AREA, borderValue=128)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
        flange = T_world_board @ inverse(T) @ inverse(X_TRUE) @ se3_exp(rng.normal(size=6) * 3e-4)
        poses.append(f"{100 + 0.1 * k:.6f} " + " ".join(f"{x:.12f}" for x in tum_from_pose(flange)))
        names.append(f"{100 + 0.1 * k:.6f} {k}.png")
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")
    (folder / "rgb.txt").write_text("\n".join(names) + "\n")
    (folder / "session.toml").write_text(
        'format = 1\nid = "board"\n[frames]\npose = "T_world_flange"\nT_flange_camera = [0, 0, 0, 0, 0, 0, 1]\n'
        "[noise]\nhand_eye_translation = 1.0\nhand_eye_rotation = 3.0\npixel = 0.3\n"
    )
    (folder / "camera.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.0, 0.0, 0.0, 0.0, 0.0]\n"
    )


def test_a_board_calibrates_the_camera_by_command(tmp_path: Path) -> None:
    folder, out = tmp_path / "session", tmp_path / "out"
    folder.mkdir()
    board_session(folder, 25, 0.5)
    assert run(["calibrate", str(folder), "--board", "charuco:7x5:0.04:0.03:4X4_50", "-o", str(out), "-q"]) == 0
    content = tomllib.loads((out / "calibration.toml").read_text())
    shift = np.array(content["T_flange_camera"][:3]) - X_TRUE[:3, 3]
    sigma = np.sqrt(np.diag(np.array(content["covariance"])))[3:]
    assert np.abs(shift).max() < 0.004
    assert (np.abs(shift) < 4.0 * sigma).all()
    assert np.array(content["covariance"]).shape == (6, 6)


def test_a_board_seen_from_one_side_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = tmp_path / "session", tmp_path / "out"
    folder.mkdir()
    board_session(folder, 6, 0.0)
    assert run(["calibrate", str(folder), "--board", "charuco:7x5:0.04:0.03:4X4_50", "-o", str(out), "-q"]) == 2
    assert "hardly turned" in capsys.readouterr().err
    assert not out.exists()
