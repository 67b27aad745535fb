"""Sessions of pictures: what is read, what is refused, what is skipped and said."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import write_folder
from numpy.typing import NDArray

from cluster_slam.detect import ColourDetector
from cluster_slam.errors import InputError
from cluster_slam.io.images import read_image_list
from cluster_slam.io.session import open_session

TOML = """format = 1
id = "pictures"
[frames]
pose = "T_world_camera"
max_time_difference = 0.02
[depth]
scale = 0.001
[noise]
pixel = 0.5
depth = 0.006
"""
CAMERA = """image_width: 160
image_height: 120
camera_matrix: {rows: 3, cols: 3, data: [100.0, 0, 80.0, 0, 100.0, 60.0, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
"""
POSES = "".join(f"{100 + k / 10:.6f} 0 0 {k / 100} 0 0 0 1\n" for k in range(4))


def png(image: NDArray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def colour(u: int = 90, v: int = 50) -> NDArray:
    image = np.full((120, 160, 3), (20, 90, 30), np.uint8)
    return cv2.circle(image, (u, v), 8, (240, 240, 240), -1)


def depth(metres: float = 0.5) -> NDArray:
    return np.full((120, 160), round(1000 * metres), np.uint16)


def session(folder: Path, **changes: str | bytes | None) -> Path:
    """Four frames, a white disc at (90, 50), 0.5 m away; files may be replaced or left out."""
    files: dict[str, str | bytes] = {"session.toml": TOML, "camera.yaml": CAMERA, "poses.txt": POSES}
    for name, image in (("rgb", colour()), ("depth", depth())):
        rows = [f"{100 + k / 10 + 0.004:.6f} {name}/{k}.png" for k in range(4)]
        files[f"{name}.txt"] = "\n".join(["# timestamp filename", *rows, ""])
        files |= {f"{name}/{k}.png": png(image) for k in range(4)}
    for name, content in changes.items():
        key = name.replace("__", "/").replace("_dot_", ".")
        if content is None:
            del files[key]
        else:
            files[key] = content
    return write_folder(folder, files)


def test_a_disc_is_a_point(tmp_path: Path) -> None:
    """(90 - 80) / 100 and (50 - 60) / 100 times 0.5 m; three hundredths of a metre from the axis each."""
    opened = open_session(session(tmp_path), detector=ColourDetector())
    assert opened.level == 1
    assert opened.observations.frame.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(opened.observations.points, np.tile([0.05, -0.05, 0.5], (4, 1)), atol=1e-3)
    assert opened.warnings == ()


def test_without_a_detector_it_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"images only \(level 1\), expected a detector"):
        open_session(session(tmp_path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth__0_dot_png": png(cv2.resize(depth(), (80, 60)))}, r"depth/0.png: 80 x 60, but 0.png is 160 x 120"),
        ({"depth__1_dot_png": png(depth().astype(np.uint8))}, r"depth/1.png: a depth image of 8 bits"),
        ({"depth__1_dot_png": png(colour())}, r"depth/1.png: a depth image of 8 bits, 3 channels"),
        ({"camera_dot_yaml": None}, r"camera.yaml: missing, expected camera intrinsics"),
        ({"depth_dot_txt": None}, r"depth.txt: missing, expected a TUM image list"),
        ({"camera_dot_yaml": CAMERA.replace("160", "320")}, r"0.png: 160 x 120, but camera.yaml is for 320 x 120"),
        ({"rgb_dot_txt": "5.0 rgb/0.png\n"}, r"no picture within max_time_difference = 0.02 s"),
        ({"rgb_dot_txt": "100.0\n"}, r"rgb.txt: row 1: '100.0', expected timestamp filename"),
        ({"rgb_dot_txt": "x rgb/0.png\n"}, r"rgb.txt: row 1: timestamp is 'x', expected seconds"),
        ({"rgb_dot_txt": "# nothing\n"}, r"rgb.txt: no image"),
    ],
)
def test_what_is_refused(tmp_path: Path, changes: dict[str, str | bytes | None], message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_session(session(tmp_path, **changes), detector=ColourDetector())


@pytest.mark.parametrize("broken", [b"", b"no image at all", png(colour())[:200]])
def test_an_unreadable_image_is_skipped_counted_and_said(tmp_path: Path, broken: bytes) -> None:
    opened = open_session(session(tmp_path, rgb__2_dot_png=broken), detector=ColourDetector())
    assert opened.observations.frame.tolist() == [0, 1, 3]
    assert len(opened.warnings) == 1
    assert "rgb/2.png: cannot be read as an image; the frame is skipped" in opened.warnings[0]


def test_a_wrong_scale_is_said(tmp_path: Path) -> None:
    folder = session(tmp_path, session_dot_toml=TOML.replace("scale = 0.001", "scale = 0.1"))
    opened = open_session(folder, detector=ColourDetector())
    assert any("median depth 50 m with scale = 0.1" in text for text in opened.warnings)


def test_no_depth_anywhere_is_said(tmp_path: Path) -> None:
    empty = {f"depth__{k}_dot_png": png(depth(0.0)) for k in range(4)}
    opened = open_session(session(tmp_path, **empty), detector=ColourDetector())
    assert len(opened.observations) == 0
    assert any("no pixel with a depth" in text for text in opened.warnings)
    assert any("4 of 4 detections have no depth" in text for text in opened.warnings)


def test_pictures_belong_to_the_nearest_pose(tmp_path: Path) -> None:
    rows = "99.985 rgb/0.png\n100.11 rgb/1.png\n100.25 rgb/2.png\n"
    opened = open_session(session(tmp_path, rgb_dot_txt=rows), detector=ColourDetector())
    assert opened.observations.frame.tolist() == [0, 1]  # 15 ms before, 10 ms after; 50 ms is too far
    assert any("2 frames of poses.txt have no pictures" in text for text in opened.warnings)


def test_a_range_image_is_lifted_along_the_ray(tmp_path: Path) -> None:
    folder = session(tmp_path, session_dot_toml=TOML.replace("[noise]", 'convention = "ray"\n[noise]'))
    points = open_session(folder, detector=ColourDetector()).observations.points
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.5, atol=1e-3)


def test_image_lists_keep_spaces_in_names(tmp_path: Path) -> None:
    path = tmp_path / "rgb.txt"
    path.write_text("# a comment\n1.5 rgb/a b.png\n\n2.5 rgb/c.png # of it\n")
    assert read_image_list(path).names == ("rgb/a b.png", "rgb/c.png")
    assert read_image_list(path).stamps.tolist() == [1.5, 2.5]
