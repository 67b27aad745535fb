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
from cluster_slam.online.records import Revision, Update

if TYPE_CHECKING:
    from cluster_slam.online.tracker import OnlineTracker

MARK_S = 1.0  # between two marks
_ROWS = np.dtype([("frame", "<i4"), ("flower", "<i4"), ("cluster", "<i4"), ("reason", "<i4"), ("nis", "<f4")])
_FRAMES = np.dtype([("stamp", "<f8"), ("pose", "<f8", 7)])
_DRIFT = np.dtype([("frame", "<i4"), ("cluster", "<i4"), ("position", "<f8", 3), ("cov", "<f4", (3, 3))])
_TABLES = {"rows.bin": _ROWS, "frames.bin": _FRAMES, "drift.bin": _DRIFT}
_TEXTS = ("revisions.txt", "warnings.txt")
_TRUSTED = ("numpy", "collections", "tracking.", "cluster_slam.", "builtins", "copyreg")
_REFUSED = {"eval", "exec", "compile", "open", "getattr", "setattr", "__import__", "input", "breakpoint", "globals"}


def journal_of(out: Path) -> Path:
    """Where the journal of a result lies."""
    return out.parent / f"{out.name}.tracking"


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """All that a journal holds: rows of points, frames and drift as structured arrays, revisions and warnings."""

    rows: NDArray[Any]
    frames: NDArray[Any]
    drift: NDArray[Any]
    revisions: tuple[str, ...]
    warnings: tuple[str, ...]


class Journal:
    """Appends what each update says; a context manager.

    Raises
    ------
    OutputError
        The disk is full, or the place cannot be written.
    """

    def __init__(self, out: Path, *, resume: bool = False) -> None:
        self.folder = journal_of(out)
        self.n_frames = 0
        self._last_mark = -np.inf
        try:
            if not resume and self.folder.exists():
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

    def write(self, update: Update, tracker: OnlineTracker) -> None:
        """Append an accepted update."""
        i, q = self.n_frames, len(update.flower_ids)
        rows = np.zeros(q, _ROWS)
        rows["frame"], rows["flower"], rows["cluster"] = i, update.flower_ids, update.cluster_ids
        rows["reason"], rows["nis"] = update.reasons, update.nis
        frame = np.zeros(1, _FRAMES)
        frame["stamp"], frame["pose"] = update.stamp, tum_from_pose(update.T_world_camera)
        tracks = update.tracks
        seen = np.flatnonzero(tracks.seen > 0)
        drift = np.zeros(len(seen), _DRIFT)
        drift["frame"], drift["cluster"] = i, tracks.ids[seen]
        drift["position"], drift["cov"] = tracks.positions[seen], tracks.covs[seen, :3, :3]
        self._append("rows.bin", rows.tobytes())
        self._append("frames.bin", frame.tobytes())
        self._append("drift.bin", drift.tobytes())
        self._append("revisions.txt", "".join(_line(update.stamp, r) for r in update.revisions).encode())
        self._append("warnings.txt", "".join(f"{update.stamp:.6f} {w}\n" for w in update.warnings).encode())
        self.n_frames += 1
        if update.stamp - self._last_mark >= MARK_S or update.stamp < self._last_mark:
            self.mark(tracker)
            self._last_mark = update.stamp

    def note(self, stamp: float, warning: str) -> None:
        """Append a warning that belongs to no accepted frame."""
        self._append("warnings.txt", f"{stamp:.6f} {warning}\n".encode())

    def mark(self, tracker: OnlineTracker) -> None:
        """From here a killed run can go on."""
        try:
            for file in self._files.values():
                file.flush()
            sizes = {name: file.tell() for name, file in self._files.items()}
            new = self.folder / "mark.new"
            new.write_bytes(pickle.dumps((self.n_frames, sizes, tracker), protocol=5))
            os.replace(new, self.folder / "mark.bin")
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written ({error.strerror})") from None

    def read(self) -> Told:
        """All that was written."""
        for file in self._files.values():
            file.flush()
        return read_journal(self.folder)

    def remove(self) -> None:
        """The result stands: the journal is not needed any more."""
        self.__exit__()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _append(self, name: str, content: bytes) -> None:
        try:
            self._files[name].write(content)
        except OSError as error:
            raise OutputError(f"{self.folder / name}: cannot be written ({error.strerror})") from None


def read_journal(folder: Path) -> Told:
    """The tables of a journal; what was cut off in the middle of a row is left out."""
    tables = []
    for name, kind in _TABLES.items():
        content = (folder / name).read_bytes()
        tables.append(np.frombuffer(content[: len(content) // kind.itemsize * kind.itemsize], kind))
    texts = [tuple((folder / name).read_text("utf-8", "replace").splitlines()) for name in _TEXTS]
    return Told(tables[0], tables[1], tables[2], texts[0], texts[1])


def resume(out: Path) -> tuple[OnlineTracker, int]:
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
        n_frames, sizes, tracker = _Reader(io.BytesIO(path.read_bytes())).load()
        for name in (*_TABLES, *_TEXTS):
            with (folder / name).open("ab") as file:
                file.truncate(int(sizes[name]))
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, TypeError, ValueError, KeyError) as error:
        raise InputError(f"{path}: cannot be read ({error}), expected a mark of this version") from None
    return tracker, int(n_frames)


class _Reader(pickle.Unpickler):
    """Reads marks, and nothing that could do anything else than hold numbers."""

    def find_class(self, module: str, name: str) -> Any:
        known = any(module == t.rstrip(".") or module.startswith(t) for t in _TRUSTED)
        if not known or name.split(".")[0] in _REFUSED:
            raise pickle.UnpicklingError(f"{module}.{name} has no place in a mark")
        return super().find_class(module, name)


def _line(stamp: float, r: Revision) -> str:
    return f"{stamp:.6f} {r.kind} {r.subject} {r.before} {r.after} {r.reason}\n"
