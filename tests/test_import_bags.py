"""Bags of ROS 1 and ROS 2, made by rosbags' writers, read back exactly; and bags that are not as they should be."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags (extra bags) is not installed")

import bags
import cv2
from bags import BEGIN, COLOUR, DEPTH, INFO, BagWriter, arm_bag

from cluster_slam.cli.app import run
from cluster_slam.geometry import pose_from_tum, tum_from_pose
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.metadata import read_metadata

KINDS = ["ros1", "sqlite3", "mcap"]


def listed(session: Path, name: str) -> list[tuple[float, Path]]:
    """Stamps and files of a list of images."""
    rows = [line.split() for line in (session / f"{name}.txt").read_text().splitlines() if not line.startswith("#")]
    return [(float(stamp), session / file) for stamp, file in rows]


def images(session: Path, name: str) -> np.ndarray:
    """All images of a list (n, h, w[, 3])."""
    return np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for _, path in listed(session, name)])


def import_error(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line of a refused import."""
    assert run(["import", *arguments]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    return error


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_is_read_back_exactly(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = arm_bag(tmp_path / "bag", kind), tmp_path / "session"
    assert run(["import", str(path), "-o", str(out), "--json", "--plant", "row3"]) == 0
    told = json.loads(capsys.readouterr().out)
    roles = {s["role"]: s["name"] for s in told["streams"] if s["role"]}
    assert roles == {"colour": COLOUR, "depth": DEPTH, "camera": INFO, "pose (tool0 in base_link)": "/tf"}
    assert np.array_equal(images(out, "rgb"), bags.colours())
    assert np.array_equal(images(out, "depth"), bags.depths())
    stamps, rows, _, _ = read_pose_file(out / "poses.txt", 0.0)
    assert np.array_equal(rows, bags.pose_rows())
    assert stamps.tolist() == [ns / 10**9 for ns in bags.stamps()]
    assert [stamp for stamp, _ in listed(out, "rgb")] == stamps.tolist()
    metadata, warnings = read_metadata(out / "session.toml")
    assert (metadata.frames.pose, metadata.plant, metadata.depth.scale) == ("T_world_flange", "row3", 0.001)
    assert metadata.frames.T_flange_camera == pytest.approx(bags.MOUNT, abs=1e-15)
    camera = read_camera(out / "camera.yaml")
    assert [camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1] == bags.K
    assert camera.distortion.tolist() == [*bags.D, 0, 0, 0]
    assert (camera.width, camera.height) == (bags.WIDTH, bags.HEIGHT)
    assert warnings == ()
    assert told["median_depth_m"] == pytest.approx(np.median([np.median(d) for d in bags.depths()]) / 1000)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_compressed_stays_as_it_is(tmp_path: Path, kind: str) -> None:
    path, out = (tmp_path / "bag").with_suffix(bags.suffix(kind)), tmp_path / "session"
    jpegs = [cv2.imencode(".jpg", image)[1].tobytes() for image in bags.colours()]
    pngs = [cv2.imencode(".png", image)[1].tobytes() for image in bags.depths()]
    with BagWriter(path, kind) as bag:
        for k, ns in enumerate(bags.stamps()):
            bag.transforms("/tf", ns, ("map", "camera_color_optical_frame", bags.pose_rows()[k]))
            bag.compressed(f"{COLOUR}/compressed", ns, jpegs[k], "rgb8; jpeg compressed bgr8")
            bag.compressed(f"{DEPTH}/compressedDepth", ns, b"\0" * 12 + pngs[k], "16UC1; compressedDepth png")
        bag.info(INFO, bags.stamps()[0])
    assert run(["import", str(path), "-o", str(out), "--quiet"]) == 0
    assert [p.read_bytes() for _, p in listed(out, "rgb")] == jpegs
    assert [p.read_bytes() for _, p in listed(out, "depth")] == pngs
    assert all(p.suffix == ".jpg" for _, p in listed(out, "rgb"))
    assert read_metadata(out / "session.toml")[0].frames.pose == "T_world_camera"
    assert np.array_equal(read_pose_file(out / "poses.txt", 0.0)[1], bags.pose_rows())


def test_a_file_of_a_folder_will_do(tmp_path: Path) -> None:
    """A bare .mcap or .db3, without its metadata."""
    for kind, ending in (("mcap", ".mcap"), ("sqlite3", ".db3")):
        folder = arm_bag(tmp_path / kind, kind)
        file = tmp_path / f"bare{ending}"
        shutil.copyfile(next(folder.glob(f"*{ending}")), file)
        assert run(["import", str(file), "-o", str(tmp_path / f"out{kind}"), "--quiet"]) == 0
        assert np.array_equal(images(tmp_path / f"out{kind}", "depth"), bags.depths())


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("bgr8", bags.colours()[0]),
        ("rgba8", np.concatenate([bags.colours()[0][..., ::-1], bags.colours()[0][..., :1]], axis=2)),
        ("bgra8", np.concatenate([bags.colours()[0], bags.colours()[0][..., :1]], axis=2)),
    ],
)
def test_pixels_of_other_orders(tmp_path: Path, encoding: str, pixels: Any) -> None:
    path = tmp_path / "b"
    with BagWriter(path, "mcap") as bag:
        bag.image(COLOUR, bags.stamps()[0], pixels, encoding)
        bag.info(INFO, bags.stamps()[0])
    assert run(["import", str(path), "-o", str(tmp_path / "s"), "--still", "--quiet"]) == 0
    assert np.array_equal(images(tmp_path / "s", "rgb")[0], bags.colours()[0])


def test_depth_in_metres(tmp_path: Path) -> None:
    """32FC1 becomes multiples of a tenth of a millimetre; what is not finite or too far is 0."""
    metres = np.full((bags.HEIGHT, bags.WIDTH), 0.51234, np.float32)
    metres[0, :4] = [np.nan, np.inf, 7.0, -1.0]
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.image(COLOUR, bags.stamps()[0], bags.colours()[0], "bgr8")
        bag.image(DEPTH, bags.stamps()[0], metres, "32FC1")
        bag.info(INFO, bags.stamps()[0])
    assert run(["import", str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--still", "--quiet"]) == 0
    depth = images(tmp_path / "s", "depth")[0]
    assert depth[0, :4].tolist() == [0, 0, 0, 0]
    assert set(depth.ravel().tolist()) == {0, 5123}
    assert read_metadata(tmp_path / "s" / "session.toml")[0].depth.scale == 0.0001


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_poses_of_a_topic(tmp_path: Path, kind: str) -> None:
    """ur_robot_driver's TCP pose, 100 Hz; at an image between two of them the pose lies between."""
    path = (tmp_path / "bag").with_suffix(bags.suffix(kind))
    turn = np.array([[0.1 * t, 0, 0, 0, 0, np.sin(0.1 * t), np.cos(0.1 * t)] for t in np.arange(0, 0.3, 0.01)])
    with BagWriter(path, kind) as bag:
        for k, row in enumerate(turn):
            ns = BEGIN * 10**9 + k * 10_000_000
            message = bag.make("geometry_msgs/msg/PoseStamped", bag.header(ns, "base"), bag.pose(row))
            bag.write("/tcp_pose_broadcaster/pose", ns, message)
        bag.image(COLOUR, BEGIN * 10**9 + 105_000_000, bags.colours()[0], "bgr8")
        bag.info(INFO, BEGIN * 10**9)
    assert run(["import", str(path), "-o", str(tmp_path / "s"), "--quiet"]) == 0
    metadata, _ = read_metadata(tmp_path / "s" / "session.toml")
    assert metadata.frames.pose == "T_world_flange"
    assert metadata.noise.hand_eye_translation == 1.0  # nobody said how the camera is mounted
    rows = read_pose_file(tmp_path / "s" / "poses.txt", 0.0)[1]
    assert rows == pytest.approx(np.array([[0.0105, 0, 0, 0, 0, np.sin(0.0105), np.cos(0.0105)]]), abs=1e-6)


def test_odometry_drifts(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b", "mcap") as bag:
        for k, ns in enumerate(bags.stamps()):
            pose = bag.make("geometry_msgs/msg/PoseWithCovariance", bag.pose(bags.pose_rows()[k]), np.zeros(36))
            zero = bag.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
            twist = bag.make("geometry_msgs/msg/Twist", zero, zero)
            speed = bag.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
            bag.write("/odom", ns, bag.make("nav_msgs/msg/Odometry", bag.header(ns, "odom"), "camera", pose, speed))
            bag.image(COLOUR, ns, bags.colours()[k], "bgr8")
        bag.info(INFO, bags.stamps()[0])
    assert run(["import", str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--quiet"]) == 0
    metadata, _ = read_metadata(tmp_path / "s" / "session.toml")
    assert (metadata.frames.pose_error, metadata.frames.pose) == ("odometry", "T_world_camera")
    assert np.array_equal(read_pose_file(tmp_path / "s" / "poses.txt", 0.0)[1], bags.pose_rows())


def test_a_chain_of_moving_joints(tmp_path: Path) -> None:
    """Two joints that move at their own rates, and a fixed one between: the product of all at common stamps."""
    rows = bags.pose_rows(9)
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.transforms("/tf_static", bags.stamps()[0], ("link", "arm", rows[8]))
        for k, ns in enumerate(bags.stamps()):
            bag.transforms("/tf", ns, ("base", "link", rows[k]))
            if k in (0, 4):
                bag.transforms("/tf", ns, ("arm", "camera_color_optical_frame", rows[6]))
            bag.image(COLOUR, ns, bags.colours()[k], "bgr8")
        bag.info(INFO, bags.stamps()[0])
    assert run(["import", str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--quiet"]) == 0
    T = pose_from_tum(rows)
    found = pose_from_tum(read_pose_file(tmp_path / "s" / "poses.txt", 0.0)[1])
    assert np.abs(found - T[:5] @ T[8] @ T[6]).max() < 1e-9
    assert run(["import", str(tmp_path / "b"), "-o", str(tmp_path / "l"), "--pose", "base > link", "--quiet"]) == 0
    assert np.array_equal(read_pose_file(tmp_path / "l" / "poses.txt", 0.0)[1], rows[:5])


def test_a_camera_with_a_clock_of_its_own(tmp_path: Path) -> None:
    """Stamps since the camera's start, 100 ppm fast, arriving 5 ms late or more: brought to the bag's clock."""
    rng = np.random.default_rng(4)
    n, late = 600, 5e-3
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.info(INFO, BEGIN * 10**9)
        for k in range(n):
            t = k / 30
            now = BEGIN * 10**9 + int(1e9 * t)
            x = np.array([0.1 * t, 0, 0, 0, 0, 0, 1.0])
            bag.transforms("/tf", now, ("base", "camera_color_optical_frame", x))
            own = int(1e9 * (77 + (1 + 1e-4) * t))
            arrival = now + int(1e9 * (late + rng.exponential(0.002)))
            bag.image(COLOUR, own, np.zeros((2, 2, 3), np.uint8), "bgr8", arrival=arrival)
    camera = tmp_path / "camera.yaml"
    camera.write_text("camera_matrix:\n  rows: 3\n  cols: 3\n  data: [30.0, 0, 1, 0, 30.0, 1, 0, 0, 1]\n")
    out = tmp_path / "s"
    assert run(["import", str(tmp_path / "b"), "-o", str(out), "--camera", str(camera), "--quiet"]) == 0
    stamps, rows, _, _ = read_pose_file(out / "poses.txt", 0.0)
    assert len(stamps) >= n - 2  # the last ones arrive after the last pose
    truth = BEGIN + np.arange(n)[: len(stamps)] / 30
    assert np.abs(stamps - truth - late).max() < 1e-3  # the smallest delay stays in the offset
    assert np.abs(rows[:, 0] - 0.1 * (stamps - BEGIN)).max() < 1e-6


# --- dry run


def test_a_dry_run_lists_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_bag(tmp_path / "bag", "mcap")
    assert run(["import", str(path), "--dry-run", "-o", str(tmp_path / "s")]) == 0
    told = capsys.readouterr().out
    assert re.search(rf"colour +│ {COLOUR}: 5 of", told)
    assert "/tf_static" in told
    assert not (tmp_path / "s").exists()
    assert run(["import", str(path), "--dry-run", "--json"]) == 0
    streams = {s["name"]: s for s in json.loads(capsys.readouterr().out)["streams"]}
    assert streams[COLOUR]["n"] == 5
    assert streams[COLOUR]["role"] == "colour"


def test_a_dry_run_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.image(COLOUR, bags.stamps()[0], bags.colours()[0], "bgr8")
    assert run(["import", str(tmp_path / "b"), "--dry-run"]) == 1
    told = capsys.readouterr()
    assert "no intrinsics" in told.err
    assert "colour " in told.out


# --- bags that are not as they should be


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_bag_that_is_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, share: float) -> None:
    path = arm_bag(tmp_path / "bag", kind)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    error = import_error(capsys, str(path), "-o", str(tmp_path / "s"))
    assert str(path) in error
    assert "cut off" in error or "no topic" in error
    assert not (tmp_path / "s").exists()


def test_a_topic_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_bag(tmp_path / "bag", "mcap")
    error = import_error(capsys, str(path), "-o", str(tmp_path / "s"), "--colour", "/camera/rgb")
    assert f"no colour '/camera/rgb', expected one of {DEPTH}, {COLOUR}" in error


def test_depth_of_another_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.image(COLOUR, bags.stamps()[0], bags.colours()[0], "bgr8")
        bag.image("/camera/depth/image_rect_raw", bags.stamps()[0], np.full((12, 16), 500, np.uint16), "16UC1")
        bag.info(INFO, bags.stamps()[0])
    error = import_error(capsys, str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--still")
    assert "16 x 12, its camera's intrinsics are of 32 x 24, expected one size (depth aligned to colour)" in error
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b"]


def test_depth_of_8_bits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.image(COLOUR, bags.stamps()[0], bags.colours()[0], "bgr8")
        bag.image(DEPTH, bags.stamps()[0], bags.colours()[0][..., 0], "mono8")
        bag.info(INFO, bags.stamps()[0])
    error = import_error(capsys, str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--still")
    assert "uint8 of 24x32, expected one channel of 16 bits" in error


def test_a_wrong_scale_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_bag(tmp_path / "bag", "mcap")
    assert run(["import", str(path), "-o", str(tmp_path / "s"), "--depth-scale", "0.05"]) == 0
    assert "is the scale right" in capsys.readouterr().err


def test_no_intrinsics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.image(COLOUR, bags.stamps()[0], bags.colours()[0], "bgr8")
        bag.info("/zero/camera_info", bags.stamps()[0], k=[0.0] * 9)
    assert "fx and fy above 0" in import_error(capsys, str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--still")


def test_an_unreadable_image_in_the_middle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    png = cv2.imencode(".png", bags.colours()[0])[1].tobytes()
    with BagWriter(tmp_path / "b", "mcap") as bag:
        for k, ns in enumerate(bags.stamps(20)):
            data = {7: b"rubbish", 9: png[:200]}.get(k, png)
            bag.compressed(f"{COLOUR}/compressed", ns, data, "png")
        bag.info(INFO, bags.stamps()[0])
    assert run(["import", str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--still", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["n_unreadable"], told["n_colour"]) == (2, 18)
    assert sum("left out" in text for text in told["warnings"]) == 2


def test_most_images_unreadable_is_poor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    png = cv2.imencode(".png", bags.colours()[0])[1].tobytes()
    with BagWriter(tmp_path / "b", "mcap") as bag:
        for k, ns in enumerate(bags.stamps()):
            bag.compressed(f"{COLOUR}/compressed", ns, png if k else b"rubbish", "png")
        bag.info(INFO, bags.stamps()[0])
    assert run(["import", str(tmp_path / "b"), "-o", str(tmp_path / "s"), "--still", "--quiet"]) == 1
    assert "1 of 5 images cannot be read" in capsys.readouterr().err


def test_no_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.image(COLOUR, bags.stamps()[0], bags.colours()[0], "bgr8")
        bag.info(INFO, bags.stamps()[0])
    error = import_error(capsys, str(tmp_path / "b"), "-o", str(tmp_path / "s"))
    assert "no poses in 2 topics" in error


def test_poses_of_another_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_bag(tmp_path / "bag", "mcap")
    poses = tmp_path / "poses.txt"
    poses.write_text("".join(f"{5 + k / 10} {k} 0 0 0 0 0 1\n" for k in range(10)))
    arguments = [str(path), "-o", str(tmp_path / "s"), "--poses", str(poses), "--pose-frame", "camera"]
    error = import_error(capsys, *arguments)
    assert f"--time-offset {BEGIN - 5:.3f}" in error
    assert run(["import", *arguments, "--time-offset", str(BEGIN - 5), "--quiet"]) == 0
    found = read_pose_file(tmp_path / "s" / "poses.txt", 0.0)[1]
    assert found[:, 0] == pytest.approx([0, 1 / 3, 2 / 3, 1, 4 / 3], abs=5e-6)  # 1 m/0.1 s, 2e-7 s


def test_out_that_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_bag(tmp_path / "bag", "mcap")
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "mine").touch()
    assert "expected a free name" in import_error(capsys, str(path), "-o", str(tmp_path / "s"))


def test_static_tf_alone_is_no_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "b", "mcap") as bag:
        bag.transforms("/tf_static", bags.stamps()[0], ("base", "camera_color_optical_frame", bags.MOUNT))
        bag.image(COLOUR, bags.stamps()[0], bags.colours()[0], "bgr8")
        bag.info(INFO, bags.stamps()[0])
    assert "no poses" in import_error(capsys, str(tmp_path / "b"), "-o", str(tmp_path / "s"))


def test_rows_are_taken_over_bit_by_bit() -> None:
    """Only what lies between two poses is computed; a gap of half a second is not bridged."""
    from cluster_slam.io.importers.poses import rows_at

    rows = bags.pose_rows(3)
    stamps = np.array([1.0, 1.1, 3.0])
    found = rows_at(stamps, rows, np.array([0.9, 1.0, 1.05, 1.1, 2.0, 3.0, 3.1]))
    assert np.array_equal(found[[1, 3, 5]], rows)
    assert np.isnan(found[[0, 4, 6]]).all()
    middle = pose_from_tum(found[2])
    steps = [np.linalg.inv(pose_from_tum(rows[0])) @ middle, np.linalg.inv(middle) @ pose_from_tum(rows[1])]
    assert np.abs(steps[0][:3, :3] - steps[1][:3, :3]).max() < 1e-9
    assert tum_from_pose(middle)[:3] == pytest.approx(rows[:2, :3].mean(axis=0))
