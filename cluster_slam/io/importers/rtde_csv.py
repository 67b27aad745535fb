"""RTDE logs as CSV: UR's ``record.py`` (spaces), ur_rtde's recorder (commas), and what people make of them.

The header names RTDE's output fields, vectors as ``actual_TCP_pose_0`` to ``_5``; line ends may be of any system. A
column ``time`` may hold the date of the host that wrote the log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.text import read_text, shown
from cluster_slam.sensors.rtde.fields import type_of
from cluster_slam.sensors.rtde.wire import N_VALUES

_DATES = ("%Y:%m:%d:%H:%M:%S.%f", "%Y-%m-%d %H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S.%f", "%Y-%m-%d %H:%M:%S")
_MIN_UNIX, _MAX_UNIX = 1e8, 1e11  # s; other numbers are no Unix time
_MAX_BAD = 0.01  # of the rows: more that cannot be read, and it is no log


@dataclass(frozen=True, slots=True, eq=False)
class RtdeLog:
    """A log: fields over the controller's time."""

    path: Path
    stamps: Array  # (n,) s, the controller's clock, strictly increasing
    columns: dict[str, Array]  # each (n, k)
    host: Array | None  # (n,) s, Unix time of the host where the log has it
    warnings: tuple[str, ...] = field(default=())

    @property
    def poses(self) -> Array:
        """Poses of the active TCP in the base's frame, (n, 4, 4).

        Raises
        ------
        InputError
            The log has none.
        """
        from cluster_slam.sensors.interpolation import pose_from_rotation_vector

        if "actual_TCP_pose" not in self.columns:
            raise InputError(f"{self.path}: row 1: no columns actual_TCP_pose_0 to actual_TCP_pose_5")
        return pose_from_rotation_vector(self.columns["actual_TCP_pose"])


def is_rtde_csv(path: Path) -> bool:
    """Whether a file's first row names RTDE's fields."""
    try:
        with path.open("rb") as file:
            head = file.read(65536)
    except OSError:
        return False
    first = head.replace(b"\r", b"\n").split(b"\n", 1)[0]
    return b"timestamp" in first and (b"actual_TCP_pose_0" in first or b"actual_q_0" in first)


def read_rtde_csv(path: Path) -> RtdeLog:
    """Read a log; rows that repeat a stamp are left out, as are rows that are cut off.

    Raises
    ------
    InputError
        No log: no timestamp, no number where one is expected, or time that runs backwards.
    """
    lines = [(i, line) for i, line in enumerate(read_text(path, "an RTDE log as CSV").split("\n"), 1) if line.strip()]
    if len(lines) < 2:
        raise InputError(f"{path}: {len(lines)} rows, expected a header and rows of numbers")
    header, separator = _header(path, lines[0][1])
    rows = [(i, [cell.strip() for cell in line.strip().split(separator)]) for i, line in lines[1:]]
    whole = [(i, cells) for i, cells in rows if len(cells) == len(header)]
    warnings = _cut_off(path, rows, len(header))
    if not whole:
        raise InputError(f"{path}: row {rows[0][0]}: {len(rows[0][1])} values, expected {len(header)} as in the header")
    numbers = {name: _numbers(path, name, k, whole) for k, name in enumerate(header) if name not in ("time", "_id")}
    stamps = numbers.pop("timestamp")
    keep = np.concatenate([[True], np.diff(stamps) != 0])
    if (back := np.diff(stamps[keep]) < 0).any():
        k = int(np.flatnonzero(keep)[int(back.argmax()) + 1])
        text = f"timestamp {stamps[k]!s} after {stamps[k - 1]!s}"
        raise InputError(f"{path}: row {whole[k][0]}: {text}, expected a later one (did the controller restart?)")
    if not keep.all():
        warnings.append(f"{path}: {(~keep).sum()} rows repeat the stamp before them and are left out")
    host = _dates(header, whole)
    columns = {name: values[keep] for name, values in _vectors(numbers).items()}
    return RtdeLog(path, stamps[keep], columns, None if host is None else host[keep], tuple(warnings))


def _header(path: Path, line: str) -> tuple[list[str], str | None]:
    """Names, and what separates them (None: white space)."""
    separator = next((sign for sign in (",", ";", "\t") if sign in line), None)
    names = [name.strip().strip('"') for name in line.strip().split(separator)]
    if "timestamp" not in names:
        raise InputError(f"{path}: row 1: no column 'timestamp' ({shown(line)}), expected the fields of RTDE")
    return names, separator


def _cut_off(path: Path, rows: Sequence[tuple[int, list[str]]], width: int) -> list[str]:
    bad = [(i, cells) for i, cells in rows if len(cells) != width]
    if len(bad) > max(1, _MAX_BAD * len(rows)):
        i, cells = bad[0]
        raise InputError(f"{path}: row {i}: {len(cells)} values, expected {width} as in the header")
    return [f"{path}: row {i}: {len(cells)} values for {width} columns; the row is left out" for i, cells in bad]


def _numbers(path: Path, name: str, k: int, rows: Sequence[tuple[int, list[str]]]) -> Array:
    try:
        values = np.array([float(cells[k]) for _, cells in rows])
    except ValueError:
        values = np.full(len(rows), np.nan)
    if not np.isfinite(values).all():
        i, cell = next((i, cells[k]) for i, cells in rows if not _is_finite(cells[k]))
        raise InputError(f"{path}: row {i}: {name} is {shown(cell)}, expected a finite number")
    return values


def _is_finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _vectors(numbers: dict[str, Array]) -> dict[str, Array]:
    """Columns (n, k) by field: ``actual_q_0`` to ``actual_q_5`` become one."""
    out = {}
    for name, values in numbers.items():
        base, _, index = name.rpartition("_")
        n = N_VALUES.get(type_of(base) or "", 1)
        parts = [f"{base}_{i}" for i in range(n)]
        if index == "0" and n > 1 and all(part in numbers for part in parts):
            out[base] = np.stack([numbers[part] for part in parts], axis=1)
        elif type_of(name) is not None and type_of(name) not in N_VALUES:
            out[name] = values[:, None]
    return out


def _dates(header: list[str], rows: Sequence[tuple[int, list[str]]]) -> Array | None:
    """Unix time (n,) of the column ``time``: a date is taken for UTC, a number for seconds.

    Some loggers write the date under ``_id``, beside a count under ``time``.
    """
    for name in ("time", "_id"):
        if name in header:
            cells = [cells[header.index(name)] for _, cells in rows]
            for read in (_seconds, *map(_date_reader, _DATES)):
                try:
                    return np.array([read(cell) for cell in cells])
                except ValueError:
                    continue
    return None


def _seconds(cell: str) -> float:
    seconds = float(cell)
    if not _MIN_UNIX < seconds < _MAX_UNIX:
        raise ValueError
    return seconds


def _date_reader(pattern: str) -> Callable[[str], float]:
    return lambda cell: datetime.strptime(cell, pattern).replace(tzinfo=UTC).timestamp()
