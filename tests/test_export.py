"""Sessions and results in the formats of other programs, and back again."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import FLOWERS_COV, LEVEL_3, TOML, write_folder
from test_import_folders import tum_folder

from cluster_slam import open_session
from cluster_slam.cli.app import run
from cluster_slam.geometry import pose_from_tum, tum_from_pose
from cluster_slam.io.exporters.g2o import result_graph, session_graph
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.read_result import read_result

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "data" / "sample"


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of smoothing the sample."""
    out = tmp_path_factory.mktemp("smoothed") / "r"
    assert run(["smooth", str(SAMPLE), "-o", str(out), "--quiet"]) == 0
    return out


def numbers(line: str, begin: int) -> np.ndarray:
    return np.array([float(x) for x in line.split()[begin:]])


def full(upper: np.ndarray, n: int) -> np.ndarray:
    """A symmetric matrix of its upper triangle, row by row."""
    out = np.zeros((n, n))
    out[np.triu_indices(n)] = upper
    return out + np.triu(out, 1).T


def test_a_session_goes_through_mcap_bit_by_bit(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags (extra bags) is not installed")
    assert run(["export", str(SAMPLE), "-o", str(tmp_path / "s.mcap"), "--quiet"]) == 0
    assert run(["import", str(tmp_path / "s.mcap"), "-o", str(tmp_path / "s"), "--quiet"]) == 0
    a, b = open_session(SAMPLE), open_session(tmp_path / "s")
    assert np.array_equal(a.stamps, b.stamps)
    assert np.array_equal(*(read_pose_file(f / "poses.txt", 0.0)[1] for f in (SAMPLE, tmp_path / "s")))
    assert np.array_equal(a.observations.frame, b.observations.frame)
    assert np.array_equal(a.observations.points, b.observations.points)
    assert np.array_equal(a.observations.covs, b.observations.covs)
    assert a.T_flange_camera is not None
    assert b.T_flange_camera is not None
    assert np.abs(a.T_flange_camera - b.T_flange_camera).max() < 1e-15
    assert b.pose_frame == "T_world_flange"


def test_scores_and_empty_frames_go_through_mcap(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags (extra bags) is not installed")
    write_folder(tmp_path / "a", {**LEVEL_3, "flowers.csv": FLOWERS_COV})
    assert run(["export", str(tmp_path / "a"), "-o", str(tmp_path / "a.mcap"), "--quiet"]) == 0
    assert run(["import", str(tmp_path / "a.mcap"), "-o", str(tmp_path / "b"), "--quiet"]) == 0
    a, b = open_session(tmp_path / "a"), open_session(tmp_path / "b")
    assert b.n_frames == 3
    assert np.array_equal(a.observations.scores, b.observations.scores, equal_nan=True)
    assert np.array_equal(a.observations.covs, b.observations.covs)


def session_of_pictures(tmp_path: Path) -> Path:
    out = tmp_path / "pictures"
    assert run(["import", str(tum_folder(tmp_path / "tum")), "-o", str(out), "--quiet"]) == 0
    return out


@pytest.mark.parametrize("ending", [".mcap", ""])
def test_pictures_go_through_bit_by_bit(tmp_path: Path, ending: str) -> None:
    """Their depth has a unit of its own (0.2 mm)."""
    if ending:
        pytest.importorskip("rosbags", reason="rosbags (extra bags) is not installed")
    source, middle = session_of_pictures(tmp_path), tmp_path / f"middle{ending}"
    assert run(["export", str(source), "-o", str(middle), "--quiet"]) == 0
    assert run(["import", str(middle), "-o", str(tmp_path / "back"), "--quiet", "--id", "pictures"]) == 0
    for name in ("rgb", "depth"):
        files = sorted(p.name for p in (source / name).iterdir())
        assert files == sorted(p.name for p in (tmp_path / "back" / name).iterdir())
        assert all((source / name / f).read_bytes() == (tmp_path / "back" / name / f).read_bytes() for f in files)
    for name in ("poses.txt", "rgb.txt", "depth.txt", "camera.yaml"):
        assert (source / name).read_text() == (tmp_path / "back" / name).read_text()
    text = (tmp_path / "back" / "session.toml").read_text()
    assert "scale = 0.0002" in text


def test_the_unit_of_depth_goes_through_a_tum_folder(tmp_path: Path) -> None:
    """A session in millimetres: read as TUM's 0.2 mm, everything would be five times too near."""
    source = session_of_pictures(tmp_path)
    text = (source / "session.toml").read_text()
    (source / "session.toml").write_text(text.replace("scale = 0.0002", "scale = 0.001"))
    assert run(["export", str(source), "-o", str(tmp_path / "middle"), "--quiet"]) == 0
    assert run(["import", str(tmp_path / "middle"), "-o", str(tmp_path / "back"), "--quiet"]) == 0
    assert "scale = 0.001\n" in (tmp_path / "back" / "session.toml").read_text()


def test_a_trajectory_as_tum(tmp_path: Path) -> None:
    """Of the camera: the mount is multiplied in."""
    assert run(["export", str(SAMPLE), "-o", str(tmp_path / "t.txt"), "--quiet"]) == 0
    session = open_session(SAMPLE)
    stamps, rows, _, _ = read_pose_file(tmp_path / "t.txt", 0.0)
    assert np.array_equal(stamps, session.stamps)
    assert np.abs(pose_from_tum(rows) - session.T_world_camera).max() < 1e-12


def test_a_graph_of_odometry(tmp_path: Path) -> None:
    """The step from frame 0 to 1 is 0.1 m and a quarter turn: its sigmas are those of the session, by hand."""
    noise = "[noise]\nflower = 0.004\npose_translation = 0.003\npose_rotation = 0.002\n"
    noise += "odometry_translation = 0.04\nodometry_rotation = 0.01\n"
    toml = TOML.split("[noise]")[0].replace('"T_world_camera"', '"T_world_camera"\npose_error = "odometry"') + noise
    session = open_session(write_folder(tmp_path / "s", {**LEVEL_3, "session.toml": toml}))
    lines = session_graph(session).splitlines()
    assert lines[0] == "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"
    assert sum(line.startswith("VERTEX_SE3:QUAT") for line in lines) == 3
    assert "FIX 0" in lines
    step = next(line for line in lines if line.startswith("EDGE_SE3:QUAT 0 1 "))
    values = numbers(step, 3)
    assert values[:7] == pytest.approx([0.1, 0, 0, 0, 0, 0.5**0.5, 0.5**0.5])
    information = full(values[7:], 6)
    assert information[0, 0] == pytest.approx(1 / (0.003**2 + (0.04 * 0.1) ** 2))
    assert information[5, 5] == pytest.approx(4 / (0.002**2 + (0.01 * np.pi / 2) ** 2))
    assert np.array_equal(information, np.diag(np.diag(information)))


def test_gtsam_reads_the_graph_of_a_result(smoothed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Poses, flowers, and every observation that was not taken for false; residuals are as small as the noise."""
    import gtsam

    assert run(["export", str(smoothed), "-o", str(tmp_path / "r.g2o"), "--json"]) == 0
    counts = json.loads(capsys.readouterr().out)["counts"]
    result = read_result(smoothed, open_session(SAMPLE))
    assert counts["VERTEX_SE3:QUAT"] == counts["EDGE_SE3_PRIOR"] == 150
    assert counts["VERTEX_TRACKXYZ"] == len(result.flowers)
    assert counts["EDGE_SE3_TRACKXYZ"] == int((result.flower_ids >= 0).sum())
    _, values = gtsam.readG2o(str(tmp_path / "r.g2o"), True)
    poses = np.stack([values.atPose3(k).matrix() for k in range(150)])
    assert np.abs(poses - result.T_world_camera).max() < 1e-9
    lines = (tmp_path / "r.g2o").read_text().splitlines()
    flowers = {int(x.split()[1]): numbers(x, 2) for x in lines if x.startswith("VERTEX_TRACKXYZ")}
    assert np.array_equal(np.stack(list(flowers.values())), result.flowers.positions)
    nis = []
    for line in (x for x in lines if x.startswith("EDGE_SE3_TRACKXYZ")):
        frame, flower = (int(x) for x in line.split()[1:3])
        values_ = numbers(line, 4)
        T = poses[frame]
        error = T[:3, :3].T @ (flowers[flower] - T[:3, 3]) - values_[:3]
        nis.append(error @ full(values_[3:], 3) @ error)
    assert 1.0 < np.median(nis) < 6.0  # 2.4 for three degrees of freedom, more where clusters sway
    assert result_graph(result) == (tmp_path / "r.g2o").read_text()


def test_a_results_trajectory(smoothed: Path, tmp_path: Path) -> None:
    assert run(["export", str(smoothed), "-o", str(tmp_path / "t.txt"), "--quiet"]) == 0
    rows = [read_pose_file(path, 0.0)[1] for path in (tmp_path / "t.txt", smoothed / "trajectory.txt")]
    assert np.abs(pose_from_tum(rows[0]) - pose_from_tum(rows[1])).max() < 1e-9
    assert tum_from_pose(pose_from_tum(rows[0])).shape == (150, 7)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ([str(SAMPLE), "-o", "{tmp}/x.xyz"], "expected tum, mcap or g2o"),
        ([str(SAMPLE), "-o", "{tmp}/taken.g2o"], "exists, expected a free name"),
        ([str(SAMPLE), "-o", "{tmp}/no/x.g2o"], "no folder"),
        (["{tmp}/nowhere", "-o", "{tmp}/x.g2o"], "expected at least one of them"),
    ],
)
def test_bad_options(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], match: str) -> None:
    (tmp_path / "taken.g2o").write_text("mine")
    assert run(["export", *(one.replace("{tmp}", str(tmp_path)) for one in arguments)]) == 2
    error = capsys.readouterr().err
    assert match in error
    assert len(error.splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["taken.g2o"]
    assert (tmp_path / "taken.g2o").read_text() == "mine"


def test_an_image_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = session_of_pictures(tmp_path)
    image = next((source / "rgb").iterdir())
    assert cv2.imread(str(image)) is not None
    image.unlink()
    assert run(["export", str(source), "-o", str(tmp_path / "out")]) == 2
    assert f"rgb/{image.name} is not there" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
