"""``camera.yaml``: intrinsics as ROS ``camera_calibration`` writes them (YAML in block or flow style)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.text import read_text, shown
from cluster_slam.sensors.camera import N_COEFFICIENTS, Camera


def read_camera(path: Path) -> Camera:
    """The camera of a ROS ``camera_info`` file.

    Raises
    ------
    InputError
        A key is missing, or its value is not what the format says.
    """
    text = "\n".join(line.split("#", 1)[0] for line in read_text(path, "camera intrinsics").split("\n"))
    K = _matrix(path, text, "camera_matrix")
    if len(K) != 9:
        raise _refuse(path, text, "camera_matrix", f"{len(K)} numbers", "9: fx 0 cx 0 fy cy 0 0 1")
    fx, skew, cx, _, fy, cy = K[:6]
    if not (fx > 0 and fy > 0 and abs(skew) < 1e-9 * fx):
        raise _refuse(path, text, "camera_matrix", f"fx {fx:g}, fy {fy:g}, skew {skew:g}", "fx > 0, fy > 0, no skew")
    size = [_size(path, text, key) for key in ("image_width", "image_height")]
    return Camera(float(fx), float(fy), float(cx), float(cy), _distortion(path, text), size[0], size[1])


def _distortion(path: Path, text: str) -> Array:
    model = _scalar(text, "distortion_model") or "plumb_bob"
    if model not in N_COEFFICIENTS:
        raise _refuse(path, text, "distortion_model", shown(model), " or ".join(N_COEFFICIENTS))
    given = _matrix(path, text, "distortion_coefficients") if "distortion_coefficients" in text else np.zeros(0)
    n = N_COEFFICIENTS[model]
    if given[n:].any():
        raise _refuse(path, text, "distortion_coefficients", f"{len(given)} numbers", f"{n} of {model}")
    out = np.zeros(8)
    out[: min(n, len(given))] = given[:n]
    return out


def _refuse(path: Path, text: str, key: str, value: str, expected: str) -> InputError:
    found = re.search(rf"^{key}\b", text, re.MULTILINE)
    row = text[: found.start()].count("\n") + 1 if found else 1
    return InputError(f"{path}: row {row}: {key} is {value}, expected {expected}")


def _scalar(text: str, key: str) -> str:
    found = re.search(rf"^{key}[ \t]*:[ \t]*(.*)$", text, re.MULTILINE)
    return found.group(1).strip().strip("\"'") if found else ""


def _size(path: Path, text: str, key: str) -> int | None:
    value = _scalar(text, key)
    if value and not value.isdecimal():
        raise _refuse(path, text, key, shown(value), "a number of pixels")
    return int(value) if value else None


def _matrix(path: Path, text: str, key: str) -> Array:
    """The ``data`` of a matrix (n,): all up to the next key at the left margin."""
    block = re.search(rf"^{key}[ \t]*:(.*?)(?=^[A-Za-z_]|\Z)", text, re.MULTILINE | re.DOTALL)
    data = re.search(r"\bdata[ \t]*:\s*(\[[^\]]*\]|(?:\s*-[ \t]+\S+)+)", block.group(1)) if block else None
    if data is None:
        raise _refuse(path, text, key, "missing or without data", "rows, cols and data: [numbers]")
    cells = re.split(r"[,\s]+", re.sub(r"^\s*-\s", " ", data.group(1).strip("[]"), flags=re.MULTILINE).strip())
    try:
        numbers = np.array([float(cell) for cell in cells if cell])
    except ValueError:
        raise _refuse(path, text, key, shown(data.group(1)), "numbers") from None
    if not np.isfinite(numbers).all():
        raise _refuse(path, text, key, shown(data.group(1)), "finite numbers")
    return numbers
