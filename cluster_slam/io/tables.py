"""CSV tables with a header, and trajectories in the TUM format, read fast and refused with file, row and value."""

from __future__ import annotations

import csv
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.text import read_text, shown
from cluster_slam.records import IntArray

NORM_TOLERANCE = 0.01  # a quaternion that is off unit norm by more is no rounding
MAX_STAMP = 1e11  # s; the year 5138: larger stamps are in milli-, micro- or nanoseconds
MAX_LENGTH = 1e7  # m; no plant or robot is farther away than this
TUM_POSE = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
UNFINISHED = "the last row has no line end: is the file cut off?"


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of numbers, and where each row stands in the file."""

    path: Path
    columns: Mapping[str, Array]  # each (n,)
    rows: IntArray  # (n,) row in the file; the header is row 1
    warnings: tuple[str, ...] = ()
    words: Mapping[str, list[str]] = field(default_factory=dict)  # columns of text, each (n,)

    def __len__(self) -> int:
        return len(self.rows)

    def stack(self, names: Sequence[str]) -> Array:
        """Columns side by side, (n, len(names))."""
        return np.stack([self.columns[name] for name in names], axis=1)

    def refuse(self, index: int, text: str) -> InputError:
        """The error for one row, to be raised."""
        return InputError(f"{self.path}: row {self.rows[index]}: {text}")


def read_table(
    path: Path,
    required: Sequence[str],
    optional: Sequence[str] = (),
    *,
    ignored: Sequence[str] = (),
    words: Sequence[str] = (),
) -> Table:
    """A CSV table's columns as numbers.

    Parameters
    ----------
    path
        The file: comma separated, one header row, columns in any order.
    required
        Columns that must be there; each value must be a finite number.
    optional
        Columns that may be there; a value that is empty or ``nan`` becomes NaN.
    ignored
        Columns that are known but not read.
    words
        Columns of text; those that are there are read.

    Returns
    -------
    Table
        With the required columns and the optional ones that are there.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    text = read_text(path, f"a table with the columns {','.join(required)}")
    lines = text.split("\n")
    header = _header(path, lines[0], required)
    warnings = [_unknown(path, header, [*required, *optional, *ignored, *words])]
    if len(lines) > 1 and lines[-1].strip():
        warnings.append(f"{path}: {UNFINISHED}")
    numbered = [(i, line) for i, line in enumerate(lines[1:], 2) if line.strip()]
    rows = np.array([i for i, _ in numbered], dtype=np.int64)
    body = _lines(path, numbered, len(header))
    names = [*required, *(name for name in optional if name in header)]
    columns = _columns(body, header, names)
    if columns is None:  # something is no number: cell by cell, to say what
        texts = {name: _column(body, header.index(name)) for name in names}
        columns = {name: _numbers(path, name, rows, cells, name in optional) for name, cells in texts.items()}
    for name, values in columns.items():
        bad = np.isinf(values) if name in optional else ~np.isfinite(values)
        if bad.any():
            k = int(bad.argmax())
            raise _no_number(path, int(rows[k]), name, body[k].split(",")[header.index(name)])
    read_words = {name: _column(body, header.index(name)) for name in words if name in header}
    return Table(path, columns, rows, tuple(w for w in warnings if w), read_words)


def _header(path: Path, line: str, required: Sequence[str]) -> list[str]:
    names = [name.strip().strip('"') for name in line.split(",")]
    expected = f"expected a header with {','.join(required)}"
    if not line.strip():
        raise InputError(f"{path}: row 1: empty, {expected}")
    if len(names) == 1 and len(required) > 1:
        for sign in (";", "\t"):
            if sign in line:
                raise InputError(f"{path}: row 1: columns separated by {sign!r}, expected commas")
    if _is_number(names[0]):
        raise InputError(f"{path}: row 1: {shown(line)}, {expected}")
    for name in names:
        if name and names.count(name) > 1:
            raise InputError(f"{path}: row 1: column {shown(name)} twice, expected once")
    for name in required:
        if name not in names:
            near = difflib.get_close_matches(name, names, 1)
            hint = f"; is it {shown(near[0])}?" if near else ""
            raise InputError(f"{path}: row 1: no column '{name}'{hint}; it has {shown(line)}, {expected}")
    return names


def _unknown(path: Path, header: Sequence[str], known: Sequence[str]) -> str:
    extra = [name for name in header if name not in known]
    if not extra:
        return ""
    free = [name for name in known if name not in header]
    near = {name: difflib.get_close_matches(name, free, 1) for name in extra}
    hints = [f"{shown(name)} (is it '{close[0]}'?)" if close else shown(name) for name, close in near.items()]
    return f"{path}: row 1: unknown columns are ignored: {', '.join(hints)}"


def _lines(path: Path, numbered: list[tuple[int, str]], width: int) -> list[str]:
    """The rows as text without quotes; each has as many cells as the header."""
    lines = [line for _, line in numbered]
    if any('"' in line for line in lines):
        lines = [_unquoted(path, i, line) for i, line in numbered]
    for (i, line), commas in zip(numbered, map(str.count, lines, repeat(",")), strict=True):
        if commas != width - 1:
            raise InputError(f"{path}: row {i}: {commas + 1} values ({shown(line)}), expected {width} as in the header")
    return lines


def _unquoted(path: Path, row: int, line: str) -> str:
    """A line whose quoted cells hold no commas any more."""
    try:
        return ",".join(cell.replace(",", " ").replace("\n", " ") for cell in next(csv.reader([line])))
    except csv.Error as error:
        raise InputError(f"{path}: row {row}: {error} ({shown(line)}), expected comma separated values") from None


def _column(lines: list[str], k: int) -> list[str]:
    return [line.split(",")[k].strip() for line in lines]


def _columns(lines: list[str], header: list[str], names: list[str]) -> dict[str, Array] | None:
    """Columns of numbers by name; None where a cell is no number."""
    if not lines:
        return {name: np.zeros(0) for name in names}
    try:
        values = np.loadtxt(lines, delimiter=",", usecols=[header.index(n) for n in names], comments=None, ndmin=2)
    except ValueError:
        return None
    return {name: np.ascontiguousarray(values[:, k]) for k, name in enumerate(names)}


def _numbers(path: Path, name: str, rows: IntArray, cells: list[str], is_optional: bool) -> Array:
    """A column, cell by cell; an optional one may have empty cells."""
    values = np.full(len(cells), np.nan)
    for k, cell in enumerate(cells):
        if cell or not is_optional:
            if not _is_number(cell):
                raise _no_number(path, int(rows[k]), name, cell)
            values[k] = float(cell)
    return values


def _no_number(path: Path, row: int, name: str, cell: str) -> InputError:
    return InputError(f"{path}: row {row}: {name} is {shown(cell.strip())}, expected a finite number")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_tum(path: Path, what: str = "a TUM trajectory") -> Table:
    """A trajectory with the columns ``timestamp tx ty tz qx qy qz qw``, stamps increasing and quaternions unit.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    lines = read_text(path, what).split("\n")
    numbered = [(i, line.split("#", 1)[0]) for i, line in enumerate(lines, 1)]
    numbered = [(i, line) for i, line in numbered if line.strip()]
    names = ("timestamp", *TUM_POSE)
    split = [line.split() for _, line in numbered]
    for (i, line), row in zip(numbered, split, strict=True):
        if len(row) != 8:
            raise InputError(f"{path}: row {i}: {len(row)} values ({shown(line)}), expected 8: {' '.join(names)}")
    rows = np.array([i for i, _ in numbered], dtype=np.int64)
    columns = {name: _numbers(path, name, rows, [row[k] for row in split], False) for k, name in enumerate(names)}
    for k, name in enumerate(names):
        if not np.isfinite(columns[name]).all():
            i = int((~np.isfinite(columns[name])).argmax())
            raise _no_number(path, int(rows[i]), name, split[i][k])
    warnings = (f"{path}: {UNFINISHED}",) if lines[-1].split("#", 1)[0].strip() else ()
    return _checked_trajectory(Table(path, columns, rows, warnings))


def _checked_trajectory(table: Table) -> Table:
    """The table with unit quaternions, refused where it is no trajectory."""
    check_stamps(table)
    steps = np.diff(table.columns["timestamp"])
    if (steps <= 0).any():
        k = int((steps <= 0).argmax()) + 1
        stamp, before = table.columns["timestamp"][k], table.columns["timestamp"][k - 1]
        raise table.refuse(k, f"timestamp {stamp!s} after {before!s}, expected a later one (strictly increasing)")
    check_lengths(table, TUM_POSE[:3])
    q = table.stack(TUM_POSE[3:])
    norm = np.linalg.norm(q, axis=1)
    bad = np.abs(norm - 1.0) > NORM_TOLERANCE
    if bad.any():
        k = int(bad.argmax())
        raise table.refuse(k, f"quaternion qx qy qz qw of norm {norm[k]:.6g}, expected 1")
    unit = q / norm[:, None] if len(q) else q
    columns = {**table.columns, **{name: unit[:, k] for k, name in enumerate(TUM_POSE[3:])}}
    return Table(table.path, columns, table.rows, table.warnings)


def check_stamps(table: Table) -> None:
    """Refuse stamps that cannot be seconds.

    Raises
    ------
    InputError
        A stamp beyond the year 5138.
    """
    stamps = table.columns["timestamp"]
    bad = np.abs(stamps) > MAX_STAMP
    if bad.any():
        k = int(bad.argmax())
        raise table.refuse(k, f"timestamp {stamps[k]!s}, expected seconds (is it in milli- or nanoseconds?)")


def check_lengths(table: Table, names: Sequence[str]) -> None:
    """Refuse coordinates that cannot be metres.

    Raises
    ------
    InputError
        A coordinate beyond 10,000 km.
    """
    for name in names:
        values = table.columns[name]
        bad = np.abs(values) > MAX_LENGTH
        if bad.any():
            k = int(bad.argmax())
            raise table.refuse(k, f"{name} is {values[k]:.6g}, expected metres (below {MAX_LENGTH:.0e})")
