"""Simulated sessions: the same bytes from the same seed, written whole, and read back as they were."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from cluster_slam.errors import ConfigError, OutputError
from cluster_slam.io.session import open_session, open_truth
from cluster_slam.io.session_writer import write_session
from cluster_slam.records import CLUTTER, Truth
from cluster_slam.simulate import PRESETS, simulate, simulate_session

MODERATE = PRESETS["moderate"]
SHORT = replace(MODERATE, duration_s=2.0)


def _digest(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    content = b"".join(path.relative_to(folder).as_posix().encode() + path.read_bytes() for path in files)
    return hashlib.sha256(content).hexdigest()


def test_the_same_seed_gives_the_same_bytes_in_any_process(tmp_path: Path) -> None:
    simulate(PRESETS["sample"], tmp_path / "here", seed=3)
    code = (
        "import sys; from pathlib import Path; from cluster_slam.simulate import PRESETS, simulate; "
        "simulate(PRESETS['sample'], Path(sys.argv[1]), seed=3)"
    )
    for hash_seed in ("1", "2"):
        out = tmp_path / f"there{hash_seed}"
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        subprocess.run([sys.executable, "-c", code, str(out)], check=True, env=environment)
        assert _digest(out) == _digest(tmp_path / "here")
    simulate(PRESETS["sample"], tmp_path / "other", seed=4)
    assert _digest(tmp_path / "other") != _digest(tmp_path / "here")


def test_an_option_of_one_part_leaves_the_others_as_they_were() -> None:
    base = simulate_session(SHORT, seed=1)
    for change in ({"miss_rate": 0.3}, {"clutter_per_frame": 2.0}, {"n_leaves": 0}, {"with_scores": True}):
        other = simulate_session(replace(SHORT, **change), seed=1)
        np.testing.assert_array_equal(other.session.poses, base.session.poses)
        np.testing.assert_array_equal(other.flower_positions, base.flower_positions)
        keys, base_keys = ((m.session.observations.frame * 1000 + m.truth.flower_ids) for m in (other, base))
        real, base_real = keys[other.truth.flower_ids >= 0], base_keys[base.truth.flower_ids >= 0]
        _, i, j = np.intersect1d(real, base_real, return_indices=True)
        assert len(i) > 0.7 * min(len(real), len(base_real))
        points = other.session.observations.points[other.truth.flower_ids >= 0]
        np.testing.assert_array_equal(points[i], base.session.observations.points[base.truth.flower_ids >= 0][j])
    faster = simulate_session(replace(SHORT, fps=60.0), seed=1)
    np.testing.assert_allclose(faster.truth.T_world_camera[::2], base.truth.T_world_camera, atol=1e-12)


def test_other_frame_rates_keep_the_duration() -> None:
    for name, n in (("moderate", 900), ("hard", 1800), ("sample", 150), ("moderate-fps5", 150), ("hard-fps60", 3600)):
        assert PRESETS[name].n_frames == n
    assert replace(MODERATE, fps=7.0).n_frames == 210
    made = simulate_session(replace(SHORT, fps=7.0), seed=0)
    np.testing.assert_allclose(np.diff(made.session.stamps), 1 / 7, atol=2.1e-6)  # stamps in whole microseconds


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_simulates(name: str) -> None:
    config = replace(PRESETS[name], duration_s=0.5)
    made = simulate_session(config, seed=0)
    seen, truth = made.session.observations, made.truth
    n, m, f = made.session.n_frames, len(seen), len(made.plant.flowers)
    assert n == max(1, round(0.5 * config.fps))
    assert made.flower_positions.shape == (n, f, 3)
    assert len(truth.flower_ids) == len(truth.cluster_ids) == m
    assert np.linalg.eigvalsh(seen.covs).min() > 0 if m else True
    assert (seen.points[:, 2] > 0).all()
    true = truth.flower_ids != CLUTTER
    np.testing.assert_array_equal(truth.cluster_ids[true], truth.rest_cluster_ids[truth.flower_ids[true]])
    assert (truth.cluster_ids[~true] == CLUTTER).all()
    assert "tiny" not in name or f == 3
    assert "huge" not in name or len(np.unique(made.plant.flower_cluster)) > 300


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"level": 2},
        {"level": 2, "distortion_k1": 0.05, "with_scores": True},
        {"with_covariances": False, "with_scores": True},
        {"pose_frame": "T_world_camera", "pose_error": "odometry"},
        {"duration_s": 0.01},
        {"miss_rate": 1.0, "clutter_per_frame": 0.0},
        {"miss_rate": 1.0, "clutter_per_frame": 3.0},
    ],
)
def test_what_is_written_is_read_back(tmp_path: Path, change: dict[str, object]) -> None:
    config = replace(SHORT, **change)
    simulate(config, tmp_path / "s", seed=2)
    made = simulate_session(config, seed=2)
    session = open_session(tmp_path / "s")
    assert session.warnings == () or config.miss_rate == 1.0
    assert (session.id, session.plant, session.level) == ("simulated-2", "simulated-2", config.level)
    np.testing.assert_array_equal(session.stamps, made.session.stamps)
    np.testing.assert_allclose(session.poses, made.session.poses, atol=1e-9)
    assert (session.pose_frame, session.pose_error) == (config.pose_frame, config.pose_error)
    if made.session.T_flange_camera is None:
        assert session.T_flange_camera is None
    else:
        np.testing.assert_allclose(session.T_flange_camera, made.session.T_flange_camera, atol=1e-12)
    for field in fields(session.noise):
        assert getattr(session.noise, field.name) == getattr(made.session.noise, field.name)
    seen, expected = session.observations, made.session.observations
    assert seen.has_covariance == expected.has_covariance
    np.testing.assert_array_equal(seen.frame, expected.frame)
    np.testing.assert_allclose(seen.points, expected.points, atol=1e-9)
    np.testing.assert_allclose(seen.covs, expected.covs, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(seen.scores, expected.scores, atol=1e-6)
    truth = open_truth(tmp_path / "s", session)
    assert truth is not None
    np.testing.assert_allclose(truth.T_world_camera, made.truth.T_world_camera, atol=1e-9)
    np.testing.assert_array_equal(truth.flower_ids, made.truth.flower_ids)
    np.testing.assert_array_equal(truth.cluster_ids, made.truth.cluster_ids)
    np.testing.assert_array_equal(truth.rest_cluster_ids, made.truth.rest_cluster_ids)
    np.testing.assert_allclose(truth.rest_positions, made.truth.rest_positions, atol=1e-9)


def test_flowers_are_written_where_they_truly_are_at_ten_times(tmp_path: Path) -> None:
    simulate(SHORT, tmp_path / "s", seed=2)
    made = simulate_session(SHORT, seed=2)
    rows = np.loadtxt(tmp_path / "s" / "truth" / "flowers.csv", delimiter=",", skiprows=1)
    stamps = np.unique(rows[:, 0])
    assert len(stamps) == 10
    frame = np.searchsorted(made.session.stamps, rows[:, 0])
    np.testing.assert_array_equal(made.session.stamps[frame], rows[:, 0])
    np.testing.assert_allclose(rows[:, 3:], made.flower_positions[frame, rows[:, 1].astype(int)], atol=1e-9)
    np.testing.assert_array_equal(rows[:, 2], made.truth.rest_cluster_ids[rows[:, 1].astype(int)])


def test_scale_reaches_camera_and_plant_but_not_the_instruments() -> None:
    small, large = (simulate_session(replace(SHORT, scale=s), seed=0) for s in (0.5, 3.0))
    depth = [np.median(made.session.observations.points[:, 2]) for made in (small, large)]
    assert depth[1] / depth[0] == pytest.approx(6.0, rel=0.3)
    error = [made.hand_eye.measured[:3, 3] - made.hand_eye.true[:3, 3] for made in (small, large)]
    np.testing.assert_array_equal(error[0], error[1])


def test_a_former_session_is_replaced_and_anything_else_refused(tmp_path: Path) -> None:
    out = tmp_path / "s"
    simulate(replace(SHORT, level=2), out, seed=1)
    simulate(SHORT, out, seed=2)
    assert sorted(path.name for path in out.iterdir()) == ["flowers.csv", "poses.txt", "session.toml", "truth"]
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
    before = _digest(out)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"holds notes\.txt"):
        simulate(SHORT, out, seed=3)
    (out / "notes.txt").unlink()
    (out / "truth" / "photo.jpg").write_text("mine")
    with pytest.raises(OutputError, match=r"holds truth/photo\.jpg"):
        simulate(SHORT, out, seed=3)
    (out / "truth" / "photo.jpg").unlink()
    assert _digest(out) == before
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "poses.txt").write_text("0 0 0 0 0 0 0 1")
    with pytest.raises(OutputError, match=r"no session\.toml"):
        simulate(SHORT, tmp_path / "poses", seed=3)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file"):
        simulate(SHORT, tmp_path / "file", seed=3)


def test_a_failed_simulation_leaves_the_former_session(tmp_path: Path) -> None:
    simulate(SHORT, tmp_path / "s", seed=1)
    before = _digest(tmp_path / "s")
    with pytest.raises(ConfigError):
        simulate(replace(SHORT, n_clusters=300, cluster_spacing_m=0.5), tmp_path / "s", seed=1)
    with pytest.raises(ConfigError, match="seed must be"):
        simulate(SHORT, tmp_path / "s", seed=-1)
    made = simulate_session(replace(SHORT, level=2), seed=1)
    with pytest.raises(OutputError, match="needs its camera"):
        write_session(tmp_path / "s", made.session, made.truth)
    assert _digest(tmp_path / "s") == before


def test_a_session_may_have_no_truth_or_a_part_of_it(tmp_path: Path) -> None:
    made = simulate_session(SHORT, seed=1)
    write_session(tmp_path / "none", made.session)
    assert open_truth(tmp_path / "none", open_session(tmp_path / "none")) is None
    T_map_world = np.eye(4)
    T_map_world[:3, 3] = [1.0, -2.0, 0.5]
    odd = replace(made.session, id='a "quoted"\nname \\ with ü')
    write_session(tmp_path / "part", odd, Truth(T_map_world=T_map_world))
    session = open_session(tmp_path / "part")
    assert session.id == odd.id
    truth = open_truth(tmp_path / "part", session)
    assert truth is not None
    assert truth.flower_ids is None
    np.testing.assert_array_equal(truth.T_map_world, T_map_world)
