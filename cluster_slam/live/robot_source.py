"""A camera on a robot, live: each view gets the pose that the robot had when it was taken."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from types import TracebackType

import numpy as np

from cluster_slam.live.robot_poses import PoseAnswer, PoseState, RobotPoses
from cluster_slam.live.view import LiveCamera, Notice, NoticeKind, View
from cluster_slam.records import Frame, Session
from cluster_slam.sensors.clock import ClockEstimator
from cluster_slam.sensors.rtde.link import LinkEvent, RobotLink, RobotSample

_WAIT_FOR_POSE_S = 0.3  # a view waits so long for the robot's samples to reach beyond it
_POLL_S = 0.002
_SAME_CLOCK_S = 2.0  # a camera whose stamps are so near to their arrival stamps by this machine's clock
NO_POSE = np.full((4, 4), np.nan)
Detector = Callable[[View], View]  # puts points in the place of images


class RobotSource:
    """Frames of a camera on an arm. Use it as a context manager.

    A frame whose pose is not known, as the robot was lost, comes with a pose of NaN: the tracker says so and goes on.
    """

    def __init__(
        self,
        link: RobotLink,
        camera: LiveCamera,
        header: Session,
        *,
        detector: Detector | None = None,
        wait_s: float = 10.0,
        on_samples: Callable[[list[RobotSample]], None] | None = None,
        on_view: Callable[[View, float], None] | None = None,
    ) -> None:
        """
        Parameters
        ----------
        link, camera
            Entered and left with this source.
        header
            What is known beforehand; ``pose_frame`` is ``T_world_flange``.
        detector
            Finds flowers in the images of a view; None where the camera's views have them.
        wait_s
            For the robot's first sample.
        on_samples, on_view
            Called with all that comes, for a recorder; a view with its time on this machine's clock.
        """
        self.header, self.poses = header, RobotPoses()
        self._link, self._camera, self._detector = link, camera, detector
        self._wait_s = wait_s
        self._on_samples, self.on_view = on_samples, on_view
        self._camera_clock = ClockEstimator()
        self._is_own_clock: bool | None = None  # whether the camera's clock is another than this machine's
        self._notices: list[Notice] = []
        self._waiting: list[View] = []
        self._is_open = True
        self._n_no_pose = self._n_too_old = 0

    def __enter__(self) -> RobotSource:
        self._link.__enter__()
        try:
            self._link.wait(self._wait_s)
            self._camera.__enter__()
        except BaseException:
            self._link.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        self._camera.__exit__(kind, error, trace)
        self._link.__exit__(kind, error, trace)

    def stop(self) -> None:
        """Let ``frames`` end; from another thread or a signal too."""
        self._is_open = False

    def notices(self) -> list[Notice]:
        """What happened since the last call."""
        told, self._notices = self._notices, []
        return told

    def frames(self) -> Iterator[Frame]:
        """Frames as they come, until the camera has no more or ``stop`` is called."""
        while self._is_open:
            frame = self.step()
            if frame is not None:
                yield frame
            elif self._camera.is_over and not self._waiting:
                return
            else:
                time.sleep(_POLL_S)

    def step(self) -> Frame | None:
        """Take in what has come; the next frame that is ready, or None."""
        samples, events = self._link.take()
        if self._on_samples is not None and samples:
            self._on_samples(samples)
        self._tell(events, self.poses.add(samples))
        self._waiting += self._camera.take()
        for text in self._camera.problems():
            self._note(NoticeKind.CAMERA, text)
        if not self._waiting:
            return None
        view = self._waiting[0]
        answer = self.poses.at(self.host_time(view))
        if answer.state is PoseState.NOT_YET and time.time() - view.arrival < _WAIT_FOR_POSE_S:
            return None
        self._waiting.pop(0)
        if answer.state is PoseState.TOO_OLD:
            self._n_too_old += 1
            if self._n_too_old == 1:
                self._note(NoticeKind.CAMERA, "views from before the robot's first sample are left out")
            return None
        return self._frame(view, answer)

    def host_time(self, view: View) -> float:
        """When a view was taken, on this machine's clock."""
        if self._is_own_clock is not False:  # one late view makes no other clock
            self._is_own_clock = abs(view.arrival - view.stamp) > _SAME_CLOCK_S
        if not self._is_own_clock:
            return view.stamp
        if self._camera_clock.add(view.stamp, view.arrival):
            self._note(NoticeKind.CLOCK, "the camera's clock was set")
        clock = self._camera_clock.clock
        return view.stamp if clock is None else float(clock.arrival(np.array([view.stamp]))[0])

    def _frame(self, view: View, answer: PoseAnswer) -> Frame:
        if self.on_view is not None:
            self.on_view(view, self.host_time(view))
        if answer.T_world_flange is None:
            self._n_no_pose += 1
            if self._n_no_pose == 1:
                self._note(NoticeKind.NO_POSE, f"the robot was silent at {view.stamp:.3f}")
        elif self._n_no_pose:
            self._note(NoticeKind.NO_POSE, f"poses again, after {self._n_no_pose} frames without")
            self._n_no_pose = 0
        seen = view if self._detector is None else self._detector(view)
        pose = NO_POSE if answer.T_world_flange is None else answer.T_world_flange
        return Frame(view.stamp, pose, seen.points, seen.covs, seen.scores)

    def _tell(self, events: list[LinkEvent], told: list[str]) -> None:
        self._notices += [Notice(one.time, NoticeKind.ROBOT, f"{one.kind}: {one.text}") for one in events]
        for text in told:
            self._note(NoticeKind.TCP if "TCP" in text else NoticeKind.CLOCK, text)

    def _note(self, kind: NoticeKind, text: str) -> None:
        self._notices.append(Notice(time.time(), kind, text))
