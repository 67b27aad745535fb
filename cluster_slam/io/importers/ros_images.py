"""Images of ROS messages as the files of a session: what is compressed stays as it is, the rest becomes PNG."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.importers.recording import Picture
from cluster_slam.io.importers.ros_bag import Bag
from cluster_slam.sensors.camera import N_COEFFICIENTS, Camera

DEPTH_METRES_SCALE = 0.0001  # m per unit that depth in metres (32FC1) is rounded to; reaches to 6.5 m
_TO_BGR = {"rgb8": [2, 1, 0], "bgr8": [0, 1, 2], "rgba8": [2, 1, 0], "bgra8": [0, 1, 2], "8UC3": [0, 1, 2]}
_GREY = {"mono8": np.uint8, "8UC1": np.uint8, "mono16": np.uint16, "16UC1": np.uint16, "32FC1": np.float32}
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"


def camera_of_info(where: str, info: Any) -> Camera:
    """The camera of a ``CameraInfo`` message (ROS 1: ``K``, ``D``; ROS 2: ``k``, ``d``).

    Raises
    ------
    InputError
        No intrinsics in it, or a distortion that is none of ours.
    """
    k = np.asarray(getattr(info, "k", getattr(info, "K", None)), float)
    d = np.asarray(getattr(info, "d", getattr(info, "D", [])), float)
    model = info.distortion_model or "plumb_bob"
    if k.shape != (9,) or not (k[0] > 0 and k[4] > 0):
        raise InputError(f"{where}: no intrinsics (K is {k.tolist()}), expected fx and fy above 0")
    if d.any() and (model not in N_COEFFICIENTS or d[N_COEFFICIENTS[model] :].any()):
        raise InputError(f"{where}: distortion {model} with {len(d)} numbers, expected {' or '.join(N_COEFFICIENTS)}")
    coefficients = np.zeros(8)
    coefficients[: min(len(d), 8)] = d[:8]
    return Camera(k[0], k[4], k[2], k[5], coefficients, int(info.width), int(info.height))


def pictures(bag: Bag, topic: str, stamps: Mapping[float, float] | None, offset: Array) -> Iterator[Picture | str]:
    """The images of a topic.

    Parameters
    ----------
    bag, topic
        Where they are.
    stamps
        Stamps by time of arrival, where they are not those of the headers.
    offset
        (2,) the stamps become ``offset[0] + offset[1] * stamp``.
    """
    from cluster_slam.io.importers.ros_bag import seconds

    for _, arrival, message in bag.messages([topic]):
        stamp = seconds(message.header.stamp) if stamps is None else stamps.get(arrival)
        if stamp is None:
            yield f"{topic}: the image at {arrival:.6f} s has no stamp"
            continue
        stamp = float(offset[0] + offset[1] * stamp)
        found = _compressed(message) if hasattr(message, "format") else _raw(topic, message)
        if isinstance(found, str):
            yield f"{topic}: the image at {stamp:.6f} s {found}"
        else:
            yield Picture(stamp, *found)


def _compressed(message: Any) -> tuple[bytes, str] | str:
    """Bytes and suffix of a compressed image; depth has a header of 12 bytes before the PNG."""
    data = bytes(message.data)
    if "compressedDepth" in message.format:
        data = data[12:]
    if data.startswith(_PNG):
        return data, ".png"
    if data.startswith(_JPEG):
        return data, ".jpg"
    return f"is neither PNG nor JPEG ({message.format!r})"


def _raw(topic: str, message: Any) -> tuple[bytes, str] | str:
    """PNG of a raw image.

    Raises
    ------
    InputError
        Pixels of a kind that is not read.
    """
    import cv2

    image = _pixels(topic, message)
    if isinstance(image, str):
        return image
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return (data.tobytes(), ".png") if done else "cannot be written as PNG"


def _pixels(topic: str, message: Any) -> NDArray[np.uint8] | NDArray[np.uint16] | str:
    encoding, h, w = message.encoding, int(message.height), int(message.width)
    if encoding not in _TO_BGR and encoding not in _GREY:
        known = ", ".join([*_TO_BGR, *_GREY])
        raise InputError(f"{topic}: pixels of the kind {encoding!r}, expected one of {known}")
    kind = np.dtype(_GREY.get(encoding, np.uint8)).newbyteorder(">" if message.is_bigendian else "<")
    n_channels = 1 if encoding in _GREY else 4 if "a8" in encoding else 3
    data = np.frombuffer(bytes(message.data), np.uint8)
    width = w * n_channels * kind.itemsize
    step = int(message.step) or width
    if len(data) < (h - 1) * step + width or step < width:
        return f"has {len(data)} bytes, expected {h} rows of {step}"
    rows = np.lib.stride_tricks.as_strided(data, (h, width), (step, 1))
    image = np.ascontiguousarray(rows).view(kind).reshape(h, w, n_channels)
    if encoding in _TO_BGR:
        return np.ascontiguousarray(image[..., _TO_BGR[encoding]]).astype(np.uint8)
    return _grey(image[..., 0])


def _grey(image: NDArray[Any]) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """One channel in the machine's byte order; metres (32FC1) as multiples of ``DEPTH_METRES_SCALE``."""
    if image.dtype.kind == "f":
        units = np.nan_to_num(image / DEPTH_METRES_SCALE, nan=0.0, posinf=0.0, neginf=0.0)
        return np.where((units > 0) & (units < 65535.5), np.rint(units), 0).astype(np.uint16)
    return image.astype(image.dtype.newbyteorder("="))
