"""A robot with a camera, opened by names: what ``track --robot`` follows."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cluster_slam.live.detecting import FlowerFinder
from cluster_slam.live.robot_source import RobotSource
from cluster_slam.live.setup import Mount, live_header, open_camera
from cluster_slam.sensors.rtde.link import RobotLink

if TYPE_CHECKING:
    from cluster_slam.io.observed import Detector


def open_robot(
    host: str,
    camera: str,
    mount: Mount,
    *,
    detector: Detector | None = None,
    rate_hz: float = 125.0,
    id: str | None = None,
    plant: str | None = None,
) -> RobotSource:
    """Frames of a camera on a Universal Robots arm; enter it, take ``frames()``, hand them to ``OnlineTracker.step``.

    Parameters
    ----------
    host
        Name or address of the arm's controller.
    camera
        ``realsense``, ``realsense:SERIAL``, or a folder that another program fills.
    mount
        How the camera sits on the arm's active TCP.
    detector
        Finds flowers in images; None where the camera's folder has their positions.
    rate_hz
        Samples of the arm a second.

    Raises
    ------
    InputError
        There is no such camera; on entering, no such robot.
    """
    header = live_header(mount, id=id, plant=plant)
    opened = open_camera(camera)
    finder = None if detector is None else FlowerFinder(detector, opened)
    return RobotSource(RobotLink(host, rate_hz=rate_hz), opened, header, detector=finder)
