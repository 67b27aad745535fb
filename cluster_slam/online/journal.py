"""What a running tracker has said, on disk as it says it: whoever is killed has lost a second at most.

The folder ``OUT.tracking`` lies beside the result that it becomes: tables that only grow, and once a second a mark with
the tracker's own state and how long each table was then. Whoever goes on from the mark cuts the tables there.
"""

from __future__ import annotations

import io
import os
import pickle
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cluster_slam.errors import InputError, OutputError
from cluster_slam.geometry import tum_from_pose
from cluster_slam.online.records import Revision, Tracks, Update

if TYPE_CHECKING:
    from cluster_slam.online.tracker import OnlineTracker
    from cluster_slam.records import Frame

MARK_S = 1.0  # between two marks
_ROWS = np.dtype([("frame", "<i4"), ("flower", "<i4"), ("cluster", "<i4"), ("reason", "<i4"), ("nis", "<f4")])
_FRAMES = np.dtype([("stamp", "<f8"), ("pose", "<f8", 7)])
_DRIFT = np.dtype([("frame", "<i4"), ("cluster", "<i4"), ("position", "<f8", 3), ("cov", "<f4", (3, 3))])
_GIVEN = np.dtype([("pose", "<f8", (4, 4))])  # of a live frame: nobody else keeps what came in
_POINTS = np.dtype([("point", "<f8", 3), ("cov", "<f8", (3, 3)), ("score", "<f8")])
_TRACKS = np.dtype(  # all clusters, seen or not, ten times a second: what an animated replay shows
    [("frame", "<i4"), ("cluster", "<i4"), ("position", "<f4", 3), ("cov", "<f4", (3, 3)), ("what", "u1")]
)
_TABLES = {"rows.bin": _ROWS, "frames.bin": _FRAMES, "drift.bin": _DRIFT, "tracks.bin": _TRACKS}
_TABLES |= {"given.bin": _GIVEN, "points.bin": _POINTS}
TENTATIVE, CONFIRMED, LOST, SWAYING, SEEN = 0, 1, 2, 4, 8  # bits of ``what``
_STATES = {"tentative": TENTATIVE, "confirmed": CONFIRMED, "lost": LOST}
_TRACKS_S = 0.1
_TEXTS = ("revisions.txt", "warnings.txt")
_OURS = (
    "cluster_slam.online.",
    "cluster_slam.grouping.",
    "cluster_slam.graph.incremental",
    "cluster_slam.config",
    "cluster_slam.records",
    "cluster_slam.association.depth_noise",
)
_PLAIN = {"list", "dict", "set", "frozenset", "tuple", "int", "float", "bool", "slice", "range", "deque", "bytearray"}
_ARRAYS = {"_reconstruct", "ndarray", "dtype", "scalar", "_frombuffer", "_convert_to_numpy_array"}


def journal_of(out: Path) -> Path:
    """Where the journal of a result lies."""
    return out.parent / f"{out.name}.tracking"


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """All that a journal holds: rows of points, frames and drift as structured arrays, revisions and warnings.

    Of a live source also what came in: ``given`` poses and ``points``; of a session these are empty.
    """

    rows: NDArray[Any]
    frames: NDArray[Any]
    drift: NDArray[Any]
    tracks: NDArray[Any]
    given: NDArray[Any]
    points: NDArray[Any]
    revisions: tuple[str, ...]
    warnings: tuple[str, ...]


class Journal:
    """Appends what each update says; a context manager.

    Raises
    ------
    OutputError
        The disk is full, or the place cannot be written.
    """

    def __init__(self, out: Path, session_id: str, *, n_frames: int = 0) -> None:
        """``n_frames`` are there already, if a run that was cut off goes on."""
        self.folder, self.session_id, self.n_frames = journal_of(out), session_id, n_frames
        self._last_mark = self._last_tracks = -np.inf
        try:
            if not n_frames and self.folder.exists():
                shutil.rmtree(self.folder)
            self.folder.mkdir(parents=True, exist_ok=True)
            self._files = {name: (self.folder / name).open("ab") for name in (*_TABLES, *_TEXTS)}
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror})") from None

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        for file in self._files.values():
            try:
                file.close()
            except OSError:
                continue  # a full disk has been told of by the write that met it

    def keep(self, frame: Frame) -> None:
        """Append what came in with a frame, before what an update says of it."""
        given, points = np.zeros(1, _GIVEN), np.zeros(len(frame), _POINTS)
        given["pose"] = frame.pose
        points["point"], points["cov"] = frame.points, frame.covs
        points["score"] = np.nan if frame.scores is None else frame.scores
        self._append("given.bin", given.tobytes())
        self._append("points.bin", points.tobytes())

    def write(self, update: Update, tracker: OnlineTracker, stamp: float | None = None) -> None:
        """Append what an update says; ``stamp`` is the frame's on a clock that never goes back, its own where None."""
        i, q = self.n_frames, len(update.flower_ids)
        rows = np.zeros(q, _ROWS)
        rows["frame"], rows["flower"], rows["cluster"] = i, update.flower_ids, update.cluster_ids
        rows["reason"], rows["nis"] = update.reasons, update.nis
        frame = np.zeros(1, _FRAMES)
        at = update.stamp if stamp is None else stamp
        frame["stamp"], frame["pose"] = at, tum_from_pose(update.T_world_camera)
        tracks = update.tracks
        seen = np.flatnonzero(tracks.seen > 0)
        drift = np.zeros(len(seen), _DRIFT)
        drift["frame"], drift["cluster"] = i, tracks.ids[seen]
        drift["position"], drift["cov"] = tracks.positions[seen], tracks.covs[seen, :3, :3]
        self._append("rows.bin", rows.tobytes())
        self._append("frames.bin", frame.tobytes())
        self._append("drift.bin", drift.tobytes())
        if at - self._last_tracks >= _TRACKS_S or at < self._last_tracks:
            self._append("tracks.bin", _tracks(i, tracks).tobytes())
            self._last_tracks = at
        self._append("revisions.txt", "".join(_line(at, r) for r in update.revisions).encode())
        self._append("warnings.txt", "".join(f"{at:.6f} {w}\n" for w in update.warnings).encode())
        self.n_frames += 1
        if at - self._last_mark >= MARK_S or at < self._last_mark:
            self.mark(tracker)
            self._last_mark = at

    def mark(self, tracker: OnlineTracker) -> None:
        """From here a killed run can go on."""
        try:
            for file in self._files.values():
                file.flush()
            sizes = {name: file.tell() for name, file in self._files.items()}
            new = self.folder / "mark.new"
            new.write_bytes(pickle.dumps((self.n_frames, sizes, self.session_id, tracker), protocol=5))
            os.replace(new, self.folder / "mark.bin")
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror})") from None

    def read(self) -> Told:
        """All that was written."""
        for file in self._files.values():
            file.flush()
        return read_journal(self.folder)

    def _append(self, name: str, content: bytes) -> None:
        try:
            self._files[name].write(content)
        except OSError as error:
            raise OutputError(f"{self.folder / name}: cannot be written ({error.strerror})") from None


def _tracks(i: int, tracks: Tracks) -> NDArray[Any]:
    rows = np.zeros(len(tracks), _TRACKS)
    rows["frame"], rows["cluster"] = i, tracks.ids
    rows["position"], rows["cov"] = tracks.positions, tracks.covs[:, :3, :3]
    bits = [
        _STATES[state] | SWAYING * (motion != "rest")
        for state, motion in zip(tracks.states, tracks.motions, strict=True)
    ]
    rows["what"] = np.array(bits, dtype=np.uint8) | SEEN * (tracks.seen > 0).astype(np.uint8)
    told: NDArray[Any] = rows[rows["what"] & 3 != TENTATIVE]
    return told


def read_journal(folder: Path) -> Told:
    """The tables of a journal; what was cut off in the middle of a row is left out."""
    tables = []
    for name, kind in _TABLES.items():
        content = (folder / name).read_bytes()
        tables.append(np.frombuffer(content[: len(content) // kind.itemsize * kind.itemsize], kind))
    texts = [tuple((folder / name).read_text("utf-8", "replace").splitlines()) for name in _TEXTS]
    return Told(tables[0], tables[1], tables[2], tables[3], tables[4], tables[5], texts[0], texts[1])


def resume(out: Path, session_id: str) -> tuple[OnlineTracker, int]:
    """The tracker as it was at the last mark, and how many frames it had taken; the tables are cut there.

    Raises
    ------
    InputError
        There is no journal, or it is none of ours.
    """
    folder = journal_of(out)
    path = folder / "mark.bin"
    if not path.exists():
        raise InputError(f"{path}: missing, expected the journal of a run that was cut off")
    try:
        n_frames, sizes, of, tracker = _Reader(io.BytesIO(path.read_bytes())).load()
        if of != session_id:
            raise InputError(f"{path}: of the session {of!r}, expected {session_id!r}")
        for name in (*_TABLES, *_TEXTS):
            with (folder / name).open("ab") as file:
                file.truncate(int(sizes[name]))
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, TypeError, ValueError, KeyError) as error:
        raise InputError(f"{path}: cannot be read ({error}), expected a mark of this version") from None
    return tracker, int(n_frames)


class _Reader(pickle.Unpickler):
    """Reads marks, and nothing that could do anything else than hold numbers."""

    def find_class(self, module: str, name: str) -> Any:
        known = (
            (module.startswith((*_OURS, "tracking.")) and "." not in name and not name.startswith("__"))
            or (module in ("builtins", "collections") and name in _PLAIN)
            or (module.startswith("numpy") and name in _ARRAYS)
            or (module == "copyreg" and name == "_reconstructor")
            or (module == "builtins" and name == "object")
        )
        if not known:
            raise pickle.UnpicklingError(f"{module}.{name} has no place in a mark")
        return super().find_class(module, name)


def _line(stamp: float, r: Revision) -> str:
    return f"{stamp:.6f} {r.kind} {r.subject} {r.before} {r.after} {r.reason}\n"
