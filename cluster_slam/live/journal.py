"""A recording in progress: all that comes is appended at once, so that whoever is killed has lost a second at most.

The folder ``SESSION.recording`` lies beside the session that it becomes. ``robot.csv`` is an RTDE log (``time`` is this
machine's, ``timestamp`` the controller's), ``frames.csv`` has a row for each view, ``rows.csv`` one for each point.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import deque
from collections.abc import Iterable
from io import TextIOWrapper
from pathlib import Path
from types import TracebackType

import numpy as np

from cluster_slam.errors import OutputError
from cluster_slam.io.importers.session_files import COV_NAMES, camera_yaml, check_free, number
from cluster_slam.live.view import Notice, View
from cluster_slam.sensors.camera import Camera
from cluster_slam.sensors.rtde.link import RobotSample

ROBOT_COLUMNS = (
    "time,timestamp,"
    + ",".join(f"actual_TCP_pose_{i}" for i in range(6))
    + ","
    + ",".join(f"actual_q_{i}" for i in range(6))
    + ",robot_mode,safety_status_bits"
)
FRAME_COLUMNS = "timestamp,camera_stamp,arrival,n_points"
ROW_COLUMNS = ",".join(["timestamp", "x", "y", "z", "score", *COV_NAMES])
NOTICE_COLUMNS = "time,kind,text"
_SYNC_S = 1.0  # so often all is on the disk
_UPPER = np.triu_indices(3)


def journal_of(out: Path) -> Path:
    """The folder of a recording in progress."""
    return out.with_name(f"{out.name}.recording")


class Journal:
    """Files that grow. Use it as a context manager."""

    def __init__(self, out: Path, head: str) -> None:
        """
        Parameters
        ----------
        out
            The session that it becomes.
        head
            ``session.toml``.

        Raises
        ------
        OutputError
            ``out`` is taken, or an unfinished recording lies beside it.
        """
        check_free(out)
        self.folder = journal_of(out)
        if self.folder.exists():
            raise OutputError(f"{self.folder}: an unfinished recording, expected none (record --finish -o {out})")
        self._files: dict[str, TextIOWrapper] = {}
        self._head = head
        self._synced = time.monotonic()
        self._has_camera = False
        self._last_stamps: deque[float] = deque(maxlen=300)
        self.n_samples = self.n_views = 0

    def __enter__(self) -> Journal:
        try:
            self.folder.mkdir(parents=True)
            (self.folder / "session.toml").write_text(self._head, "utf-8")
            for name, columns in (
                ("robot.csv", ROBOT_COLUMNS),
                ("frames.csv", FRAME_COLUMNS),
                ("rows.csv", ROW_COLUMNS),
                ("notices.csv", NOTICE_COLUMNS),
            ):
                self._files[name] = (self.folder / name).open("w", encoding="utf-8")
                self._files[name].write(columns + "\n")
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror})") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for file in self._files.values():
            with contextlib.suppress(OSError):  # the disk is full, and that has been said
                file.close()

    def samples(self, samples: Iterable[RobotSample]) -> None:
        """What the robot said."""
        for sample in samples:
            numbers = (sample.arrival, sample.stamp, *sample.pose, *sample.joints)
            row = [*map(number, numbers), str(sample.robot_mode), str(sample.safety_bits)]
            self._write("robot.csv", row)
            self.n_samples += 1

    def view(self, view: View, stamp: float) -> None:
        """What the camera saw at a time of this machine's clock."""
        if stamp in self._last_stamps:  # a camera that repeats itself
            return
        self._last_stamps.append(stamp)
        self.n_views += 1
        word = number(stamp)
        for point, score, cov in zip(view.points.tolist(), view.scores.tolist(), view.covs, strict=True):
            numbers = [*point, score, *cov[_UPPER].tolist()]
            self._write("rows.csv", [word, *("" if x != x else number(x) for x in numbers)])
        self._images(view, word)
        self._write("frames.csv", [word, number(view.stamp), number(view.arrival), str(len(view.points))])

    def intrinsics(self, camera: Camera | None) -> None:
        """The camera of the images, once it is known."""
        if camera is not None and not self._has_camera:
            (self.folder / "camera.yaml").write_text(camera_yaml(camera), "utf-8")
            self._has_camera = True

    def notices(self, notices: Iterable[Notice]) -> None:
        """What happened."""
        for one in notices:
            self._write("notices.csv", [f"{one.time:.3f}", one.kind.value, one.text.replace(",", ";")])

    def keep(self) -> None:
        """Bring it to the disk, once a second.

        Raises
        ------
        OutputError
            The disk is full.
        """
        if time.monotonic() - self._synced < _SYNC_S:
            return
        self._synced = time.monotonic()
        try:
            for file in self._files.values():
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise self._full(error) from None

    def _images(self, view: View, word: str) -> None:
        import cv2

        for folder, image in (("rgb", view.colour), ("depth", view.depth)):
            if image is None:
                continue
            (self.folder / folder).mkdir(exist_ok=True)
            done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            try:
                (self.folder / folder / f"{word}.png").write_bytes(data.tobytes() if done else b"")
            except OSError as error:
                raise self._full(error) from None

    def _write(self, name: str, cells: Iterable[str]) -> None:
        try:
            self._files[name].write(",".join(cells) + "\n")
        except OSError as error:
            raise self._full(error) from None

    def _full(self, error: OSError) -> OutputError:
        text = f"cannot be written any more ({error.strerror}); what was recorded is there"
        return OutputError(f"{self.folder}: {text} (record --finish)")
