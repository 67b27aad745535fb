"""Folders of images: TUM RGB-D and Open3D captures; folders that are neither."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from cluster_slam.cli.app import run
from cluster_slam.geometry import se3_exp, tum_from_pose
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.metadata import read_metadata

CAMERA = """image_width: 32
image_height: 24
camera_matrix:
  rows: 3
  cols: 3
  data: [30.0, 0, 15.5, 0, 30, 11.5, 0, 0, 1]
"""
STAMPS = ["1341841278.8427", "1341841278.8765", "1341841278.9101"]


def colour() -> bytes:
    image = np.random.default_rng(1).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def depth(value: int = 5000) -> bytes:
    return cv2.imencode(".png", np.full((24, 32), value, np.uint16))[1].tobytes()


def tum_folder(folder: Path) -> Path:
    """Three colour images, three of depth 4 ms later, poses at 100 Hz."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    late = [f"{float(s) + 0.004:.4f}" for s in STAMPS]
    for s, d in zip(STAMPS, late, strict=True):
        (folder / "rgb" / f"{s}.jpg").write_bytes(colour())
        (folder / "depth" / f"{d}.png").write_bytes(depth())
    (folder / "rgb.txt").write_text("# colour\n" + "".join(f"{s} rgb/{s}.jpg\n" for s in STAMPS))
    (folder / "depth.txt").write_text("# depth\n" + "".join(f"{d} depth/{d}.png\n" for d in late))
    t = 1341841278.8 + 0.01 * np.arange(20)
    (folder / "groundtruth.txt").write_text("".join(f"{x:.4f} {x - t[0]:.4f} 0 1 0 0 0.6 0.8\n" for x in t))
    (folder / "camera.yaml").write_text(CAMERA)
    return folder


def test_a_tum_folder(tmp_path: Path) -> None:
    folder, out = tum_folder(tmp_path / "fr3"), tmp_path / "s"
    assert run(["import", str(folder), "-o", str(out), "--quiet"]) == 0
    stamps, rows, _, _ = read_pose_file(out / "poses.txt", 0.0)
    assert stamps.tolist() == [float(s) for s in STAMPS]
    assert rows[:, 0] == pytest.approx(stamps - 1341841278.8, abs=1e-6)  # between the poses
    assert rows[:, 3:] == pytest.approx(np.tile([0, 0, 0.6, 0.8], (3, 1)), abs=1e-15)
    metadata, _ = read_metadata(out / "session.toml")
    assert (metadata.depth.scale, metadata.frames.pose, metadata.id) == (0.0002, "T_world_camera", "fr3")
    assert sorted(p.read_bytes() for p in (out / "rgb").iterdir()) == [colour()] * 3
    assert sorted(p.read_bytes() for p in (out / "depth").iterdir()) == [depth()] * 3
    assert len((out / "depth.txt").read_text().splitlines()) == 4
    assert read_camera(out / "camera.yaml").cx == 15.5


def test_a_session_of_pictures_keeps_its_mount(tmp_path: Path) -> None:
    """A folder that is a session already: what its poses are of is not forgotten."""
    folder = tum_folder(tmp_path / "t")
    (folder / "groundtruth.txt").rename(folder / "poses.txt")
    frames = '[frames]\npose = "T_world_flange"\nT_flange_camera = [0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0]\n'
    (folder / "session.toml").write_text(f'format = 1\nid = "mine"\n{frames}[depth]\nscale = 0.0001\n')
    assert run(["import", str(folder), "-o", str(tmp_path / "s"), "--quiet"]) == 0
    metadata, _ = read_metadata(tmp_path / "s" / "session.toml")
    assert (metadata.id, metadata.frames.pose, metadata.depth.scale) == ("mine", "T_world_flange", 0.0001)
    assert metadata.frames.T_flange_camera == [0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0]


def open3d_folder(folder: Path) -> tuple[Path, np.ndarray]:
    """Three numbered images with intrinsics column by column and a Redwood log."""
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    for k in range(3):
        (folder / "color" / f"{k:06d}.jpg").write_bytes(colour())
        (folder / "depth" / f"{k:06d}.png").write_bytes(depth(600))
    k = [30.0, 0.0, 0.0, 0.0, 31.0, 0.0, 15.5, 11.5, 1.0]
    intrinsics = {"width": 32, "height": 24, "intrinsic_matrix": k}
    (folder / "camera_intrinsic.json").write_text(json.dumps(intrinsics))
    T = se3_exp(np.random.default_rng(2).normal(size=(3, 6)))
    lines = [f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(repr, row)) for row in T[i].tolist()) for i in range(3)]
    (folder / "trajectory.log").write_text("\n".join(lines) + "\n")
    return folder, T


def test_an_open3d_capture(tmp_path: Path) -> None:
    folder, T = open3d_folder(tmp_path / "capture")
    out = tmp_path / "s"
    assert run(["import", str(folder), "-o", str(out), "--rate", "10", "--quiet"]) == 0
    stamps, rows, _, _ = read_pose_file(out / "poses.txt", 0.0)
    assert np.array_equal(stamps, [0.0, 0.1, 0.2])
    assert np.array_equal(rows, tum_from_pose(T))
    camera = read_camera(out / "camera.yaml")
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (30.0, 31.0, 15.5, 11.5, 32)
    assert sorted(p.read_bytes() for p in (out / "depth").iterdir()) == [depth(600)] * 3
    assert read_metadata(out / "session.toml")[0].depth.scale == 0.001


def refused(capsys: pytest.CaptureFixture[str], folder: Path, *options: str) -> str:
    """The one line of a refused import; nothing was written."""
    out = folder.parent / "s"
    assert run(["import", str(folder), "-o", str(out), *options]) == 2
    assert not out.exists()
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    return error


def test_tum_folders_that_are_not_as_they_should_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tum_folder(tmp_path / "t")
    (folder / "camera.yaml").unlink()
    assert "no intrinsics (no camera.yaml), expected --camera" in refused(capsys, folder)
    (folder / "camera.yaml").write_text(CAMERA.replace("32", "64"))
    assert "32 x 24, its camera's intrinsics are of 64 x 24" in refused(capsys, folder)
    (folder / "camera.yaml").write_text(CAMERA)
    (folder / "groundtruth.txt").unlink()
    assert "no trajectory" in refused(capsys, folder)
    (folder / "groundtruth.txt").write_text("5.0 0 0 0 0 0 0 1\n6.0 0 0 0 0 0 0 1\n")
    assert "no time in common (--time-offset 1341841273.843" in refused(capsys, folder)
    (folder / "rgb.txt").write_text("nonsense\n")
    assert "rgb.txt: row 1" in refused(capsys, folder)


def test_an_image_that_is_missing_or_broken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tum_folder(tmp_path / "t")
    (folder / "rgb" / f"{STAMPS[1]}.jpg").write_bytes(colour()[:50])
    next((folder / "depth").iterdir()).unlink()
    assert run(["import", str(folder), "-o", str(tmp_path / "s"), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["n_unreadable"], told["n_colour"], told["n_depth"]) == (2, 2, 2)
    assert any("cannot be read" in text for text in told["warnings"])


def test_open3d_captures_that_are_not_as_they_should_be(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, _ = open3d_folder(tmp_path / "c")
    log = (folder / "trajectory.log").read_text()
    (folder / "trajectory.log").write_text("\n".join(log.splitlines()[:-1]))
    assert "expected five for each pose" in refused(capsys, folder)
    (folder / "trajectory.log").write_text(log.replace("\n", " 1\n", 2))
    assert "four numbers a row" in refused(capsys, folder)
    (folder / "trajectory.log").unlink()
    assert "no trajectory" in refused(capsys, folder)
    (folder / "camera_intrinsic.json").write_text("{}")
    assert "intrinsic_matrix" in refused(capsys, folder, "--still")


@pytest.mark.parametrize("name", ["nothing.xyz", "nowhere"])
def test_what_is_no_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    (tmp_path / "nothing.xyz").write_text("?")
    assert "expected a ROS 1 or 2 bag" in refused(capsys, tmp_path / name)
    (tmp_path / "folder").mkdir()
    assert "a folder with nothing" in refused(capsys, tmp_path / "folder")


@pytest.mark.recordings
@pytest.mark.skipif("CLUSTER_SLAM_DATA" not in os.environ, reason="no recordings (CLUSTER_SLAM_DATA)")
def test_the_real_tum_folder(tmp_path: Path) -> None:
    source = Path(os.environ["CLUSTER_SLAM_DATA"]) / "tum-cabinet"
    assert run(["import", str(source), "-o", str(tmp_path / "s"), "--quiet"]) == 0
    a, b = (read_pose_file(folder / "poses.txt", 0.0) for folder in (source, tmp_path / "s"))
    assert np.array_equal(a[0], b[0])
    assert np.array_equal(a[1], b[1])
    for path in (source / "depth").iterdir():
        copies = list((tmp_path / "s" / "depth").glob(f"{float(path.stem)!r}.png"))
        assert copies[0].read_bytes() == path.read_bytes()
