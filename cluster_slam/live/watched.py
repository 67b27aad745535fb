"""A folder that another program fills, as a camera: rows of ``flowers.csv`` or ``detections.csv``, or images.

Rows belong to the frame of their stamp; the frame is complete when a row of another stamp follows, or when nothing has
been added for a while. Images lie in ``rgb`` (and ``depth``) and are named by their stamps, as TUM's are.
"""

from __future__ import annotations

import time
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.flowers import POINT_COV, symmetric
from cluster_slam.io.importers.session_files import DepthCamera
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.session import stated_noise
from cluster_slam.io.text import shown
from cluster_slam.live.view import View, empty_view
from cluster_slam.records import StatedNoise
from cluster_slam.sensors.camera import Camera

_SETTLE_S = 0.2  # a frame whose rows stop coming is complete after so long
_LOOK_S = 0.01  # between two looks into the folder
DONE = "done"  # a file of this name: no more will come
_SUFFIXES = (".png", ".jpg", ".jpeg")


class Tail:
    """The complete lines that are added to a text file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._at = 0
        self._rest = b""

    def lines(self) -> list[str]:
        """Lines since the last call; a line without its end is left for later."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._at)
                data = file.read()
        except FileNotFoundError:
            return []
        self._at += len(data)
        *whole, self._rest = (self._rest + data).split(b"\n")
        return [line.decode("utf-8", "replace").strip("\r\ufeff ") for line in whole]


class WatchedTable:
    """``flowers.csv`` (points) as it grows."""

    def __init__(self, folder: Path, noise: StatedNoise) -> None:
        self._tail = Tail(folder / "flowers.csv")
        self._noise = noise
        self._header: list[str] = []
        self._rows: list[Array] = []  # of the frame that is not complete
        self._last_growth = time.monotonic()
        self._n_bad = 0
        self.problems: list[str] = []

    def skip(self) -> None:
        """Leave out what is there already: it is of another time."""
        self.take()
        self._rows, self.problems = [], []

    def take(self) -> list[View]:
        """Views that are complete."""
        lines = [line for line in self._tail.lines() if line]
        if lines and not self._header:
            self._header = _header(self._tail.path, lines.pop(0))
        if lines:
            self._last_growth = time.monotonic()
        views = []
        for line in lines:
            row = self._row(line)
            if row is None:
                self._refuse(line)
                continue
            if self._rows and row[0] != self._rows[0][0]:
                views.append(self._view())
            self._rows.append(row)
        if self._rows and time.monotonic() - self._last_growth > _SETTLE_S:
            views.append(self._view())
        return views

    def _refuse(self, line: str) -> None:
        """A row that is none is told: the first, the tenth, the hundredth ..."""
        self._n_bad += 1
        if str(self._n_bad).strip("0") == "1":
            text = f"{self._tail.path}: {shown(line)} is no row of {','.join(self._header)}"
            self.problems.append(text + (f" ({self._n_bad} in all)" if self._n_bad > 1 else ""))

    @property
    def is_empty(self) -> bool:
        """Whether nothing waits to be complete."""
        return not self._rows

    def _row(self, line: str) -> Array | None:
        """Stamp, point, score and covariance (11,); None where the line is no row."""
        cells = dict(zip(self._header, line.split(","), strict=False))
        try:
            point = [float(cells[name]) for name in ("timestamp", "x", "y", "z")]
            score = float(cells.get("score") or "nan")
            cov = [float(cells[name]) for name in POINT_COV] if POINT_COV[0] in cells else self._isotropic()
        except (ValueError, KeyError):
            return None
        return np.array([*point, score, *cov])

    def _isotropic(self) -> list[float]:
        var = self._noise.flower**2
        return [var, 0.0, 0.0, var, 0.0, var]

    def _view(self) -> View:
        rows = np.array(self._rows)
        self._rows = []
        return View(float(rows[0, 0]), time.time(), rows[:, 1:4], symmetric(rows[:, 5:]), rows[:, 4])


def _header(path: Path, line: str) -> list[str]:
    names = [name.strip() for name in line.split(",")]
    missing = [name for name in ("timestamp", "x", "y", "z") if name not in names]
    if missing:
        raise InputError(f"{path}: row 1: no column '{missing[0]}', expected timestamp,x,y,z")
    return names


class WatchedImages:
    """Images that appear in ``rgb`` and ``depth``; an image is taken when it can be read whole."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: set[str] = set()
        self._has_depth = False

    def skip(self) -> None:
        """Leave out what is there already."""
        self._seen |= {path.name for path in (self._folder / "rgb").glob("*")}

    def take(self) -> list[View]:
        """Views of new images, by stamp."""
        new = [path for path in sorted((self._folder / "rgb").glob("*")) if path.name not in self._seen]
        self._has_depth = self._has_depth or any((self._folder / "depth").glob("*"))
        views = [self._view(path) for path in new if path.suffix.lower() in _SUFFIXES]
        return sorted((view for view in views if view is not None), key=lambda view: view.stamp)

    def _view(self, path: Path) -> View | None:
        import cv2

        try:
            stamp = float(path.stem)
        except ValueError:
            self._seen.add(path.name)
            return None
        depth_path = self._folder / "depth" / f"{path.stem}.png"
        colour = cv2.imread(str(path), cv2.IMREAD_COLOR)
        depth = cv2.imread(str(depth_path), cv2.IMREAD_UNCHANGED) if depth_path.exists() else None
        if depth is not None and depth.dtype != np.uint16:
            raise InputError(f"{depth_path}: depth of type {depth.dtype}, expected 16 bits")
        if colour is None or (self._has_depth and depth is None):
            return None  # half written; the next call tries again
        self._seen.add(path.name)
        base = empty_view(stamp, path.stat().st_mtime)
        return View(
            stamp,
            base.arrival,
            base.points,
            base.covs,
            base.scores,
            np.asarray(colour, np.uint8),
            None if depth is None else np.asarray(depth, np.uint16),
        )


class WatchedFolder:
    """A folder that grows, as a camera. It is over when a file ``done`` lies in it and all is taken.

    What was there before it is entered is of an earlier run, and left out.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise InputError(f"{folder}: missing, expected a folder that a camera's program fills")
        self._folder = folder
        metadata = read_metadata(folder / "session.toml")[0] if (folder / "session.toml").exists() else None
        own = folder / "camera.yaml"
        self.intrinsics: Camera | None = read_camera(own) if own.exists() else None
        self.depth_scale: float | None = metadata.depth.scale if metadata else 0.001 if own.exists() else None
        self.depth_camera: DepthCamera | None = metadata.depth.camera if metadata else None
        self._table = WatchedTable(folder, StatedNoise() if metadata is None else stated_noise(metadata))
        self._images = WatchedImages(folder)
        self._is_over = False
        self._looked = -float("inf")  # monotonic

    def __enter__(self) -> Self:
        self._table.skip()
        self._images.skip()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return

    @property
    def is_over(self) -> bool:
        """Whether the folder is done and all of it taken."""
        return self._is_over

    def problems(self) -> list[str]:
        """Rows that are none."""
        told, self._table.problems = self._table.problems, []
        return told

    def take(self) -> list[View]:
        """New views: of the table where there is one, else of the images."""
        if time.monotonic() - self._looked < _LOOK_S:
            return []
        self._looked = time.monotonic()
        is_done = (self._folder / DONE).exists()  # first: what comes before it is not missed
        views = self._table.take() if (self._folder / "flowers.csv").exists() else self._images.take()
        self._is_over = is_done and not views and self._table.is_empty
        return views
