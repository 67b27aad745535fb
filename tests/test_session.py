"""Sessions in: values that can be checked by hand, every optional part, the sloppiness of real files, and speed."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from folders import CAMERA, COV_HEADER, DETECTIONS, FLOWERS, FLOWERS_COV, LEVEL_2, LEVEL_3, POSES, TOML, write_folder

from cluster_slam.io.session import open_session, open_truth
from cluster_slam.records import StatedNoise


def opened(tmp_path: Path, level: int | None = None, **files: str | bytes):  # type: ignore[no-untyped-def]
    names = {name.replace("__", "."): content for name, content in files.items()}
    return open_session(write_folder(tmp_path / "s", {**LEVEL_3, **names}), level=level)


def test_flowers_without_covariance(tmp_path: Path) -> None:
    session = opened(tmp_path)
    assert (session.id, session.plant, session.level, session.n_frames) == ("small", "row3", 3, 3)
    assert session.pose_frame == "T_world_camera"
    assert session.pose_error == "absolute"
    assert session.T_flange_camera is None
    assert session.noise == StatedNoise(flower=0.004, pixel=0.5, depth=0.01)
    np.testing.assert_array_equal(session.stamps, [100.0, 100.1, 100.2])
    np.testing.assert_array_equal(session.observations.frame, [0, 0, 2])
    np.testing.assert_array_equal(session.observations.points[1], [-0.1, 0.25, 0.75])
    np.testing.assert_allclose(session.observations.covs, np.tile(1.6e-5 * np.eye(3), (3, 1, 1)), rtol=1e-12)
    assert not session.observations.has_covariance
    assert np.isnan(session.observations.scores).all()
    assert session.warnings == ()


def test_poses_are_the_rows(tmp_path: Path) -> None:
    T = opened(tmp_path).T_world_camera
    quarter = [[0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]  # 90 degrees about z
    half = [[1, 0, 0, 0.2], [0, -1, 0, 0.5], [0, 0, -1, -1], [0, 0, 0, 1]]  # 180 degrees about x
    np.testing.assert_allclose(T, [np.eye(4), quarter, half], atol=1e-15)


def test_covariances_and_scores(tmp_path: Path) -> None:
    seen = opened(tmp_path, flowers__csv=FLOWERS_COV).observations
    assert seen.has_covariance
    np.testing.assert_array_equal(seen.covs[0], [[1e-4, 2e-5, 3e-5], [2e-5, 2e-4, 1e-5], [3e-5, 1e-5, 4e-4]])
    np.testing.assert_array_equal(seen.scores, [0.9, 0.8, np.nan])


def test_columns_in_any_order_with_more_of_them(tmp_path: Path) -> None:
    rows = "label,z,y,x,timestamp\nred flower,0.5,0.2,0.1,100.000000\nx,0.75,0.25,-0.1,100.000000\n"
    session = opened(tmp_path, flowers__csv=rows)
    np.testing.assert_array_equal(session.observations.points, [[0.1, 0.2, 0.5], [-0.1, 0.25, 0.75]])
    (warning,) = session.warnings
    assert "flowers.csv: row 1: unknown columns are ignored: 'label'" in warning


def test_a_column_that_is_nearly_known_is_named(tmp_path: Path) -> None:
    (warning,) = opened(tmp_path, flowers__csv=FLOWERS.replace("z\n", "z,scores\n").replace("5\n", "5,1\n")
                        .replace(".6\n", ".6,1\n")).warnings  # fmt: skip
    assert "'scores' (is it 'score'?)" in warning


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda text: "\ufeff" + text, id="byte order mark"),
        pytest.param(lambda text: text.replace("\n", "\r\n"), id="CRLF"),
        pytest.param(lambda text: text.replace("\n", "\r"), id="CR"),
        pytest.param(lambda text: text.replace("\n", "\n\n"), id="blank lines"),
        pytest.param(lambda text: text.replace(",", " , "), id="spaces"),
    ],
)
def test_sloppy_text_reads_the_same(tmp_path: Path, change) -> None:  # type: ignore[no-untyped-def]
    clean = opened(tmp_path / "a", flowers__csv=FLOWERS_COV)
    sloppy = opened(
        tmp_path / "b", flowers__csv=change(FLOWERS_COV), poses__txt=change(POSES), session__toml=change(TOML)
    )
    np.testing.assert_array_equal(sloppy.observations.covs, clean.observations.covs)
    np.testing.assert_array_equal(sloppy.poses, clean.poses)
    assert sloppy.warnings == ()


def test_quoted_cells(tmp_path: Path) -> None:
    text = 'timestamp,x,y,z,note\n"100.0","0.1",0.2,0.5,"red, small"\n'
    np.testing.assert_array_equal(opened(tmp_path, flowers__csv=text).observations.points, [[0.1, 0.2, 0.5]])


def test_flange_and_hand_eye(tmp_path: Path) -> None:
    toml = TOML.replace('"T_world_camera"', '"T_world_flange"\nT_flange_camera = [0, 0, 0.05, 0, 0, 0, 1]')
    session = opened(tmp_path, session__toml=toml)
    assert session.T_flange_camera is not None
    np.testing.assert_allclose(session.T_world_camera[2, :3, 3], [0.2, 0.5, -1.05], atol=1e-15)


def test_hand_eye_of_camera_poses_is_not_used(tmp_path: Path) -> None:
    toml = TOML.replace('"T_world_camera"', '"T_world_camera"\nT_flange_camera = [0, 0, 0.05, 0, 0, 0, 1]')
    assert opened(tmp_path, session__toml=toml).T_flange_camera is None


def test_quaternion_within_a_percent_is_normalised(tmp_path: Path) -> None:
    session = opened(tmp_path, poses__txt=POSES.replace("-1 1 0 0 0", "-1 1.005 0 0 0"))
    np.testing.assert_allclose(session.poses[2, :3, :3], np.diag([1, -1, -1]), atol=1e-15)


def test_stamps_agree_within_a_microsecond(tmp_path: Path) -> None:
    """Unix times lose up to 0.24 microseconds as float64: the border must not fall on the wrong side of it."""
    poses = "1700000000.123456 0 0 0 0 0 0 1\n1700000000.123459 0 0 0 0 0 0 1\n"
    rows = "timestamp,x,y,z\n1700000000.123457,0,0,1\n1700000000.123458,0,0,1\n1700000000.123459,0,0,1\n"
    seen = opened(tmp_path, poses__txt=poses, flowers__csv=rows).observations
    np.testing.assert_array_equal(seen.frame, [0, 1, 1])


def test_rows_need_not_be_sorted(tmp_path: Path) -> None:
    head, *rows = FLOWERS.splitlines()
    seen = opened(tmp_path, flowers__csv="\n".join([head, *reversed(rows), ""])).observations
    np.testing.assert_array_equal(seen.frame, [2, 0, 0])


def test_no_flowers_and_one_frame(tmp_path: Path) -> None:
    session = opened(tmp_path, flowers__csv="timestamp,x,y,z\n", poses__txt="5.0 0 0 0 0 0 0 1\n")
    assert (session.n_frames, len(session.observations)) == (1, 0)
    assert session.observations.points.shape == (0, 3)
    assert session.observations.covs.shape == (0, 3, 3)
    with_cov = opened(tmp_path / "b", flowers__csv=COV_HEADER + "\n").observations
    assert with_cov.covs.shape == (0, 3, 3)


def test_level_2_by_hand(tmp_path: Path) -> None:
    session = open_session(write_folder(tmp_path, LEVEL_2))
    assert session.level == 2
    # u = 420: (420 - 320) / 400 = 0.25; v = 290: (290 - 240) / 500 = 0.1
    np.testing.assert_allclose(session.observations.points, [[0.125, 0, 0.5], [0, 0.1, 1], [-1, -0.8, 2]], atol=1e-15)
    cov = session.observations.covs[1]  # on the axis in x: sigma x = 0.5 / 400; y mixes pixel and depth
    along = 0.01 * np.array([0, 0.1, 1.0])
    pixels = np.diag([(0.5 / 400) ** 2, (0.5 / 500) ** 2, 0])
    np.testing.assert_allclose(cov, pixels + np.outer(along, along), rtol=1e-12, atol=1e-20)
    np.testing.assert_array_equal(session.observations.scores, [0.9, 0.8, 0.7])
    assert session.observations.has_covariance


def test_level_2_depth_along_the_ray(tmp_path: Path) -> None:
    toml = TOML + '[depth]\nconvention = "ray"\n'
    session = open_session(write_folder(tmp_path, {**LEVEL_2, "session.toml": toml}))
    np.testing.assert_allclose(np.linalg.norm(session.observations.points, axis=1), [0.5, 1, 2], rtol=1e-14)
    np.testing.assert_allclose(session.observations.points[2, :2] / session.observations.points[2, 2], [-0.5, -0.4])


def test_the_highest_level_unless_another_is_named(tmp_path: Path) -> None:
    files = {**LEVEL_2, **LEVEL_3, "rgb.txt": "100.0 rgb/1.png\n"}
    folder = write_folder(tmp_path, files)
    assert open_session(folder).level == 3
    assert open_session(folder, level=2).level == 2


def test_flow_style_and_lists_of_camera_yaml(tmp_path: Path) -> None:
    flow = """# of a camera
camera_matrix: {rows: 3, cols: 3, data: [400, 0, 320,
   0, 500, 240, 0, 0, 1]}
distortion_model: "plumb_bob"
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
    listed = "camera_matrix:\n  data:\n" + "".join(f"  - {x}\n" for x in (400, 0, 320, 0, 500, 240, 0, 0, 1))
    expected = open_session(write_folder(tmp_path / "a", LEVEL_2)).observations.points
    for name, text in (("b", flow), ("c", listed)):
        session = open_session(write_folder(tmp_path / name, {**LEVEL_2, "camera.yaml": text}))
        np.testing.assert_array_equal(session.observations.points, expected)


def test_detections_outside_of_the_image_are_named(tmp_path: Path) -> None:
    text = DETECTIONS.replace("420,240", "700,240")
    session = open_session(write_folder(tmp_path, {**LEVEL_2, "detections.csv": text, "camera.yaml": CAMERA}))
    (warning,) = session.warnings
    assert "detections.csv: row 2: u 700, v 240 is outside" in warning


MILLIMETRES = {
    "flowers": {"flowers.csv": "timestamp,x,y,z\n100.0,100,200,500\n100.2,10,-20,600\n"},
    "flowers, not sigmas": {"flowers.csv": "timestamp,x,y,z\n100.0,1,2,90\n100.2,1,-2,91\n"},
    "sigmas": {"session.toml": TOML.replace("0.004", "4.0")},
    "covariances": {"flowers.csv": f"{COV_HEADER}\n100.0,0.1,0.2,0.5,1,9,0,0,9,0,9\n"},
    "poses": {"poses.txt": "100.0 0 0 0 0 0 0 1\n100.1 500 0 0 0 0 0 1\n100.2 0 0 0 0 0 0 1\n"},
    "hand-eye": {
        "session.toml": TOML.replace('"T_world_camera"', '"T_world_flange"\nT_flange_camera = [0, 0, 50, 0, 0, 0, 1]')
    },
}


@pytest.mark.parametrize("files", MILLIMETRES.values(), ids=MILLIMETRES.keys())
def test_millimetres_are_suspected(tmp_path: Path, files: dict[str, str]) -> None:
    (warning,) = open_session(write_folder(tmp_path, {**LEVEL_3, **files})).warnings
    assert "millimetres?" in warning


def test_points_behind_the_camera_are_suspected(tmp_path: Path) -> None:
    (warning,) = opened(tmp_path, flowers__csv=FLOWERS.replace(",0.", ",-0.")).warnings
    assert "optical frame" in warning


def test_a_file_without_its_last_line_end_is_suspected(tmp_path: Path) -> None:
    (warning,) = opened(tmp_path, flowers__csv=FLOWERS[:-2]).warnings
    assert "flowers.csv" in warning
    assert "cut off?" in warning


def test_unknown_keys_are_named(tmp_path: Path) -> None:
    session = opened(tmp_path, session__toml=TOML.replace("flower =", "flowr =") + "[site]\nname = 1\n")
    assert session.noise.flower == StatedNoise().flower
    assert any("row 7: unknown key noise.flowr is ignored; is it noise.flower?" in w for w in session.warnings)
    assert any("unknown key site" in w for w in session.warnings)


TRUTH = {
    "truth/poses.txt": POSES,
    "truth/observations.csv": "flower_id,cluster_id\n4,1\n-1,-1\n5,1\n",
    "truth/rest.csv": "flower_id,cluster_id,x,y,z\n4,1,0.1,0.2,0.3\n5,1,0.4,0.5,0.6\n",
}


def test_truth(tmp_path: Path) -> None:
    toml = TOML + "[truth]\nT_map_world = [1, 2, 3, 0, 0, 0, 1]\n"
    session = opened(tmp_path, session__toml=toml, **TRUTH)
    truth = open_truth(tmp_path / "s", session)
    assert truth is not None
    assert truth.T_world_camera is not None
    assert truth.T_map_world is not None
    assert truth.rest_positions is not None
    np.testing.assert_array_equal(truth.T_world_camera, session.poses)
    np.testing.assert_array_equal(truth.flower_ids, [4, -1, 5])
    np.testing.assert_array_equal(truth.cluster_ids, [1, -1, 1])
    np.testing.assert_array_equal(truth.rest_flower_ids, [4, 5])
    np.testing.assert_array_equal(truth.rest_positions[1], [0.4, 0.5, 0.6])
    np.testing.assert_array_equal(truth.T_map_world[:3, 3], [1, 2, 3])


def test_each_part_of_the_truth_may_be_missing(tmp_path: Path) -> None:
    assert open_truth(tmp_path / "s", opened(tmp_path)) is None
    for k, name in enumerate(TRUTH):
        session = opened(tmp_path / str(k), **{name: TRUTH[name]})
        truth = open_truth(tmp_path / str(k) / "s", session)
        assert truth is not None
        parts = [truth.T_world_camera, truth.flower_ids, truth.rest_positions]
        assert [part is not None for part in parts] == [i == k for i in range(3)]


def test_true_poses_of_some_frames_and_of_others(tmp_path: Path) -> None:
    """Motion capture loses frames and has more of its own."""
    poses = "99.5 9 9 9 0 0 0 1\n100.1000009 0.7 0 0 0 0 0 1\n100.15 9 9 9 0 0 0 1\n"
    truth = open_truth(tmp_path / "s", opened(tmp_path, **{"truth/poses.txt": poses}))
    assert truth is not None
    assert truth.T_world_camera is not None
    assert np.isnan(truth.T_world_camera[[0, 2]]).all()
    np.testing.assert_array_equal(truth.T_world_camera[1, :3, 3], [0.7, 0, 0])


def test_speed(tmp_path: Path) -> None:
    """108,000 rows with covariances: measured 0.5 s of a core, where csv row by row takes 1.5 s and more."""
    n, per_frame = 1800, 60
    stamps = [f"{1.7e9 + i / 30:.6f}" for i in range(n)]
    poses = "".join(f"{t} 0 0 0 0 0 0 1\n" for t in stamps)
    rows = "".join(
        f"{t},0.1,0.2,0.{i + 1},0.9,1e-4,2e-5,3e-5,2e-4,1e-5,4e-4\n" for t in stamps for i in range(per_frame)
    )
    folder = write_folder(tmp_path, {**LEVEL_3, "poses.txt": poses, "flowers.csv": f"{COV_HEADER}\n{rows}"})
    begin = time.process_time()
    session = open_session(folder)
    assert time.process_time() - begin < 2.0
    assert len(session.observations) == n * per_frame


@pytest.mark.recordings
@pytest.mark.skipif("CLUSTER_SLAM_DATA" not in os.environ, reason="CLUSTER_SLAM_DATA names no folder of recordings")
def test_real_recordings() -> None:
    folders = sorted(path.parent for path in Path(os.environ["CLUSTER_SLAM_DATA"]).glob("*/flowers.csv"))
    assert folders
    for folder in folders:
        session = open_session(folder)
        open_truth(folder, session)
        assert session.warnings == ()
