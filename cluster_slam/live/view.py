"""What a camera gives, what a source of frames is, and what both know beforehand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.io.importers.session_files import DepthCamera
from cluster_slam.records import Frame, Session
from cluster_slam.sensors.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One instant of a camera, before anybody knows where it was."""

    stamp: float  # s, the camera's clock
    arrival: float  # s, Unix time of this machine when it was there
    points: Array  # (q, 3) camera frame, m; empty where there are only images
    covs: Array  # (q, 3, 3) m^2
    scores: Array  # (q,) NaN where there is none
    colour: NDArray[np.uint8] | None = None  # (h, w, 3) BGR
    depth: NDArray[np.uint16] | None = None  # (h, w) in units of the camera's depth scale


def empty_view(stamp: float, arrival: float) -> View:
    """A view in which nothing was seen."""
    return View(stamp, arrival, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))


class LiveCamera(Protocol):
    """Something that gives views: a folder that grows, a RealSense. Used as a context manager."""

    intrinsics: Camera | None  # of the images, as soon as they are known
    depth_scale: float | None  # m per unit of the depth images
    depth_camera: DepthCamera | None  # whose depth it is

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    @property
    def is_over(self) -> bool:
        """Whether no view will come any more."""
        ...

    def take(self) -> list[View]:
        """Views since the last call; never waits."""
        ...

    def problems(self) -> list[str]:
        """What could not be read since the last call, in words."""
        ...


class FrameSource(Protocol):
    """Something that gives frames with poses, as they come."""

    header: Session  # what is known beforehand: frames of the poses, hand-eye, noise; without frames of its own

    def frames(self) -> Iterator[Frame]:
        """Frames in the order of their arrival; waits for the next one, ends when no more can come."""
        ...

    def notices(self) -> list[Notice]:
        """What happened to the source since the last call: the robot lost and back, clocks set, frames skipped."""
        ...


class NoticeKind(Enum):
    """What can happen to a source."""

    ROBOT = "robot"  # connected, lost, stopped: the text says
    NO_POSE = "no pose"  # frames without a pose of the robot
    CLOCK = "clock"  # a clock was set
    TCP = "tcp"  # the active tool's point was changed: the hand-eye transform holds no longer
    CAMERA = "camera"  # the camera's own


@dataclass(frozen=True, slots=True)
class Notice:
    """One thing that happened to a source."""

    time: float  # s, Unix time
    kind: NoticeKind
    text: str
