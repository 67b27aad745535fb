"""``rgb.txt`` and ``depth.txt`` (level 1): pictures in the TUM layout, read one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.tables import MAX_STAMP
from cluster_slam.io.text import read_text, shown
from cluster_slam.records import IntArray
from cluster_slam.sensors.camera import Camera

FAR_M = 10.0  # a median depth beyond this is no plant in front of an arm


@dataclass(frozen=True, slots=True, eq=False)
class ImageList:
    """A TUM image list."""

    path: Path
    stamps: Array  # (n,) s, not decreasing
    names: tuple[str, ...]  # relative to the list's folder
    rows: IntArray  # (n,) row in the file


@dataclass(frozen=True, slots=True, eq=False)
class ImageFolder:
    """What a session of level 1 holds, before any picture is opened: frames, their files, the camera."""

    folder: Path
    camera: Camera
    frame: IntArray  # (k,) frames that have both pictures
    colour: tuple[str, ...]  # (k,)
    depth: tuple[str, ...]  # (k,)
    scale: float  # metres per unit of a depth image
    n_without: int  # frames without pictures near them in time


@dataclass(frozen=True, slots=True, eq=False)
class FramePictures:
    """One frame's pictures; what could not be read is said in ``problem``."""

    frame: int
    colour: NDArray[np.uint8] | None  # (h, w, 3) blue, green, red
    depth: Array | None  # (h, w) m, 0 where there is none
    problem: str = ""


def read_image_list(path: Path) -> ImageList:
    """A TUM image list: ``timestamp filename`` a row, ``#`` begins a comment.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    stamps, names, rows = [], [], []
    for row, line in enumerate(read_text(path, "a TUM image list").split("\n"), 1):
        words = line.split("#", 1)[0].split(maxsplit=1)
        if not words:
            continue
        if len(words) != 2:
            raise InputError(f"{path}: row {row}: {shown(line)}, expected timestamp filename")
        stamps.append(_stamp(path, row, words[0]))
        names.append(words[1].strip())
        rows.append(row)
        if len(stamps) > 1 and stamps[-1] < stamps[-2]:
            raise InputError(f"{path}: row {row}: timestamp {words[0]} after {stamps[-2]}, expected increasing ones")
    if not names:
        raise InputError(f"{path}: no image, expected rows of timestamp filename")
    return ImageList(path, np.array(stamps), tuple(names), np.array(rows, dtype=np.int64))


def _stamp(path: Path, row: int, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not abs(value) < MAX_STAMP:
        raise InputError(f"{path}: row {row}: timestamp is {shown(word)}, expected seconds")
    return value


def open_images(folder: Path, stamps: Array, *, scale: float, max_time_difference: float) -> ImageFolder:
    """The pictures of a session's frames: of each frame the nearest in time, if near enough.

    Parameters
    ----------
    folder
        The session.
    stamps
        (n,) of the frames, s.
    scale
        Metres per unit of a depth image.
    max_time_difference
        Of a picture from its frame, s.

    Raises
    ------
    InputError
        A list is missing or wrong, there are no intrinsics, or no frame has pictures.
    """
    colour, depth = read_image_list(folder / "rgb.txt"), read_image_list(folder / "depth.txt")
    camera = read_camera(folder / "camera.yaml")
    i, off_colour = _nearest(colour.stamps, stamps)
    j, off_depth = _nearest(depth.stamps, stamps)
    limit = max_time_difference + np.spacing(np.abs(stamps))
    frame = np.flatnonzero((off_colour <= limit) & (off_depth <= limit))
    if not len(frame):
        nearest = float(np.maximum(off_colour, off_depth).min())
        raise InputError(
            f"{colour.path}: no picture within max_time_difference = {max_time_difference:g} s of a pose "
            f"(nearest {nearest:.3g} s), expected stamps on the clock of poses.txt"
        )
    return ImageFolder(
        folder,
        camera,
        frame,
        tuple(colour.names[k] for k in i[frame].tolist()),
        tuple(depth.names[k] for k in j[frame].tolist()),
        scale,
        len(stamps) - len(frame),
    )


def _nearest(stamps: Array, wanted: Array) -> tuple[IntArray, Array]:
    """Index of the nearest stamp (n,) and how far it is off, s."""
    after = np.clip(np.searchsorted(stamps, wanted), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(stamps[after] - wanted) < np.abs(stamps[before] - wanted), after, before)
    return nearest, np.abs(stamps[nearest] - wanted)


def pictures(images: ImageFolder) -> Iterator[FramePictures]:
    """The pictures of one frame after the other; a file that cannot be read is a problem of its frame.

    Raises
    ------
    InputError
        Pictures of a wrong kind: that is no accident of one frame.
    """
    for frame, colour_name, depth_name in zip(images.frame.tolist(), images.colour, images.depth, strict=True):
        colour, depth = images.folder / colour_name, images.folder / depth_name
        seen, units = read_colour(colour), read_depth_units(depth)
        if seen is None or units is None:
            yield FramePictures(frame, None, None, f"{colour if seen is None else depth}: cannot be read as an image")
            continue
        _check_sizes(images.camera, colour, seen, depth, units)
        yield FramePictures(frame, seen, units.astype(np.float64) * images.scale)


def read_colour(path: Path) -> NDArray[np.uint8] | None:
    """A picture (h, w, 3), 8 bits, blue green red; None where the file is missing or no image."""
    import cv2

    data = _bytes(path)
    image = None if data is None else cv2.imdecode(data, cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image, np.uint8)


def read_depth_units(path: Path) -> NDArray[np.uint16] | None:
    """A depth image (h, w) of 16 bits; None where the file is missing or no image.

    Raises
    ------
    InputError
        An image of another kind: 8 bits, or in colour.
    """
    import cv2

    data = _bytes(path)
    image = None if data is None else cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if image is None:
        return None
    image = np.asarray(image)
    if image.dtype != np.uint16 or image.squeeze().ndim != 2:
        kind = f"{image.dtype.itemsize * 8} bits, {1 if image.ndim == 2 else image.shape[2]} channels"
        raise InputError(f"{path}: a depth image of {kind}, expected 16 bits and one channel (is it a picture of it?)")
    return image.reshape(image.shape[:2])


def _bytes(path: Path) -> NDArray[np.uint8] | None:
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        return None
    return data if len(data) else None


def _check_sizes(camera: Camera, colour: Path, seen: NDArray[np.uint8], depth: Path, units: NDArray[np.uint16]) -> None:
    size, other = seen.shape[1::-1], units.shape[::-1]
    if size != other:
        raise InputError(
            f"{depth}: {other[0]} x {other[1]}, but {colour.name} is {size[0]} x {size[1]}, expected depth that is "
            "aligned to colour, pixel by pixel"
        )
    known = (camera.width, camera.height)
    if None not in known and known != size:
        raise InputError(
            f"{colour}: {size[0]} x {size[1]}, but camera.yaml is for {known[0]} x {known[1]}, expected the same size"
        )
