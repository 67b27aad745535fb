"""Updates as lines of JSON, one a frame, for whoever listens; nobody who listens slowly can hold the tracker up.

The schema is in docs/tracking.md; ``format`` counts its versions.
"""

from __future__ import annotations

import json
import queue
import re
import socket
import sys
import threading
from typing import Any, Protocol

import numpy as np

from cluster_slam.errors import ConfigError, OutputError
from cluster_slam.geometry import tum_from_pose
from cluster_slam.online.records import Tracks, Update
from cluster_slam.records import RejectReason

FORMAT = 1
_ADDRESS = re.compile(r"tcp://(127\.0\.0\.1|localhost|\[::1\]):(\d{1,5})")
_QUEUE = 300  # lines that wait for a slow reader; then the oldest are left out
_CLOSE_S = 2.0
_WORDS = {int(reason): reason.name.lower() for reason in RejectReason}
_UPPER = np.triu_indices(3)


def line(update: Update) -> str:
    """One line of JSON without a newline."""
    return json.dumps(as_json(update), separators=(",", ":"), allow_nan=False)


def as_json(update: Update) -> dict[str, Any]:
    """What a line says."""
    return {
        "format": FORMAT,
        "stamp": update.stamp if np.isfinite(update.stamp) else None,
        "accepted": update.is_accepted,
        "reason": update.reason,
        "T_world_camera": _rounded(tum_from_pose(update.T_world_camera)),
        "pose_sigma": [float(f"{x:.3g}") for x in np.sqrt(np.diag(update.pose_cov)).tolist()],
        "flowers": update.flower_ids.tolist(),
        "clusters": update.cluster_ids.tolist(),
        "reasons": [_WORDS[r] for r in update.reasons.tolist()],
        "tracks": [_track(update.tracks, j) for j in range(len(update.tracks))],
        "revisions": [
            {"kind": r.kind, "subject": r.subject, "before": r.before, "after": r.after, "reason": r.reason}
            for r in update.revisions
        ],
        "warnings": list(update.warnings),
    }


def _track(tracks: Tracks, j: int) -> dict[str, Any]:
    return {
        "id": int(tracks.ids[j]),
        "state": tracks.states[j],
        "motion": tracks.motions[j],
        "reason": tracks.reasons[j],
        "position": _rounded(tracks.positions[j]),
        "velocity": _rounded(tracks.velocities[j]),
        "cov": [float(f"{x:.4g}") for x in tracks.covs[j, :3, :3][_UPPER].tolist()],
        "scale": round(float(tracks.scales[j]), 4),
        "flowers": int(tracks.n_flowers[j]),
        "seen": int(tracks.seen[j]),
    }


def _rounded(values: Any) -> list[float]:
    return [round(float(x), 9) for x in np.asarray(values).ravel()]


class Sink(Protocol):
    """Somewhere that lines go."""

    def write(self, text: str) -> None: ...

    def close(self) -> None: ...


class Stream:
    """Hands lines to a sink in a thread of its own. ``warnings`` says what was lost.

    ``patient``: wait for a slow reader (a recording that is replayed can); else the oldest lines are left out.
    """

    def __init__(self, sink: Sink, *, patient: bool) -> None:
        self._sink, self._patient = sink, patient
        self._lines: queue.Queue[str | None] = queue.Queue(_QUEUE)
        self._is_gone = False
        self.n_dropped = 0
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def put(self, update: Update) -> None:
        """Say what an update says."""
        if self._is_gone:
            return
        text = line(update) + "\n"
        while not self._is_gone:
            try:
                self._lines.put(text, timeout=0.1 if self._patient else 0.0)
                return
            except queue.Full:
                if not self._patient:
                    self._leave_out()

    def _leave_out(self) -> None:
        try:
            self._lines.get_nowait()
            self.n_dropped += 1
        except queue.Empty:
            return

    def close(self) -> tuple[str, ...]:
        """Wait a moment for what is left; returns what was lost."""
        if not self._is_gone:
            try:
                self._lines.put(None, timeout=_CLOSE_S)
            except queue.Full:
                self.n_dropped += self._lines.qsize()
        self._thread.join(_CLOSE_S)
        self._sink.close()
        told = [f"the stream's reader was too slow: {self.n_dropped} lines were left out"] if self.n_dropped else []
        return (*told, *(["the stream's reader has gone; tracking went on"] if self._is_gone else []))

    def _work(self) -> None:
        while (text := self._lines.get()) is not None:
            try:
                self._sink.write(text)
            except (OSError, ValueError):
                self._is_gone = True
                return


class StandardOutput:
    """Lines on stdout."""

    def write(self, text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()

    def close(self) -> None:
        """Standard output stays open."""


class Port:
    """A TCP port on loopback: whoever listens there is sent the lines; if nobody does, this listens itself."""

    def __init__(self, host: str, port: int) -> None:
        self._readers: list[socket.socket] = []
        self._server: socket.socket | None = None
        try:
            self._readers.append(socket.create_connection((host, port), timeout=1.0))
        except OSError:
            try:
                self._server = socket.create_server((host, port))
            except OSError as error:
                raise OutputError(f"tcp://{host}:{port}: cannot be opened ({error.strerror})") from None
            self._server.setblocking(False)

    def write(self, text: str) -> None:
        """To all readers; one that has gone is forgotten. The only one we were sent to must not go."""
        self._accept()
        for reader in list(self._readers):
            try:
                reader.sendall(text.encode())
            except OSError:
                reader.close()
                self._readers.remove(reader)
        if self._server is None and not self._readers:
            raise OSError("the reader has gone")

    def _accept(self) -> None:
        while self._server is not None:
            try:
                reader, _ = self._server.accept()
            except BlockingIOError:
                return
            reader.settimeout(1.0)
            self._readers.append(reader)

    def close(self) -> None:
        for end in (*self._readers, *([] if self._server is None else [self._server])):
            end.close()


def open_stream(where: str, *, patient: bool) -> Stream:
    """``-`` for standard output, ``tcp://127.0.0.1:PORT`` for a port on loopback.

    Raises
    ------
    ConfigError
        Neither of the two, or a port of another machine.
    OutputError
        The port cannot be opened.
    """
    if where == "-":
        return Stream(StandardOutput(), patient=patient)
    found = _ADDRESS.fullmatch(where)
    if found is None or not 0 < int(found[2]) < 65536:
        raise ConfigError(f"stream {where!r}, expected - for standard output or tcp://127.0.0.1:PORT")
    return Stream(Port(found[1].strip("[]"), int(found[2])), patient=patient)
