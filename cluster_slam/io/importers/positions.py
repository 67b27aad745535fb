"""Flower positions per frame as MATLAB users log them: ``.csv`` and ``.mat``, long or wide, with or without a header.

Long: a row a flower, ``frame x y z`` or ``time x y z``. Wide: a row a frame, ``[time] x1 y1 z1 x2 y2 z2 ...``, missing
flowers empty or NaN. A ``.mat`` file may hold such a matrix, a cell of (n, 3) matrices with one cell a frame, or an
array (n, 3, frames); a matrix (frames, 7) or an array (4, 4, frames) beside it are poses, a vector of the frames' times
is one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.importers.recording import FlowerRows, Imported, ImportOptions, Stream, choose
from cluster_slam.io.importers.session_files import SessionHead
from cluster_slam.io.text import read_text, shown
from cluster_slam.records import IntArray

_MILLIMETRES_M = 50.0  # a median distance beyond this is in millimetres
_TIMES = ("timestamp", "time", "t", "stamp")
_FRAMES = ("frame", "index", "image", "k", "i")


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """Points and the frame of each; times where the file has them."""

    frame: IntArray  # (m,)
    points: Array  # (m, 3) in the file's unit
    times: Array | None  # (n,) s, of the frames
    scores: Array | None = None  # (m,)
    poses: Array | None = None  # (n, 7)


def read_positions(path: Path, options: ImportOptions) -> Imported:
    """A ``.csv`` or ``.mat`` file with positions per frame.

    Raises
    ------
    InputError
        Nothing in it looks like positions, or what was chosen does not.
    """
    found, streams, words = _mat(path, options) if path.suffix == ".mat" else _csv(path)
    n_frames = int(found.frame.max()) + 1 if len(found.frame) else 0
    n_frames = max(n_frames, 0 if found.times is None else len(found.times))
    stamps = found.times if found.times is not None else np.arange(n_frames) / options.rate_hz
    unit, warnings = _unit(path, found.points, options.unit_m)
    if found.times is None:
        warnings.append(f"{path}: frames without times are taken {options.rate_hz:g} times a second (--rate)")
    rows, pose_stamps, head = _poses(path, options, found, stamps, warnings)
    flowers = FlowerRows(stamps[found.frame], unit * found.points, None, found.scores)
    return Imported(words, tuple(streams), head, pose_stamps, rows, stamps, flowers=flowers, warnings=tuple(warnings))


def _poses(
    path: Path, options: ImportOptions, found: Positions, stamps: Array, warnings: list[str]
) -> tuple[Array, Array, SessionHead]:
    head = SessionHead(options.id or path.stem, options.plant, source=f"imported from {path.name}")
    frame = options.pose_frame or "T_world_camera"
    if options.poses_file is not None:
        pose_stamps, rows, guess, more = read_pose_file(options.poses_file, options.time_offset_s)
        warnings += more
        frame = options.pose_frame or guess
    elif found.poses is not None and len(found.poses) == len(stamps):
        pose_stamps, rows = stamps, found.poses
    else:
        if not options.is_still:
            warnings.append(f"{path}: no poses, the camera is taken to stand still (--poses FILE)")
        pose_stamps, rows = stamps, np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(stamps), 1))
    known = options.T_flange_camera
    if frame == "T_world_flange" and known is None:
        raise InputError(f"{path}: poses of the flange, expected --hand-eye 'TX TY TZ QX QY QZ QW' beside them")
    changed = SessionHead(head.id, head.plant, frame, T_flange_camera=known, source=head.source)
    return rows, pose_stamps, changed


def _unit(path: Path, points: Array, unit_m: float | None) -> tuple[float, list[str]]:
    """Metres per unit; a guess of millimetres is told."""
    if unit_m is not None or not len(points):
        return unit_m or 1.0, []
    median = float(np.median(np.linalg.norm(points, axis=1)))
    if median > _MILLIMETRES_M:
        return 0.001, [f"{path}: median distance {median:.4g}, taken for millimetres (--unit m keeps them)"]
    return 1.0, []


# --- tables


def _csv(path: Path) -> tuple[Positions, list[Stream], str]:
    lines = [(i, line) for i, line in enumerate(read_text(path, "positions").split("\n"), 1) if line.strip()]
    if not lines:
        raise InputError(f"{path}: row 1: empty, expected positions per frame")
    separator = next((sign for sign in (",", ";", "\t") if sign in lines[0][1]), None)
    cells = [(i, [c.strip().strip('"') for c in line.split(separator)]) for i, line in lines]
    header = None if _is_numeric(cells[0][1]) else [name.lower() for name in cells.pop(0)[1]]
    width = len(header) if header is not None else len(cells[0][1])
    matrix = np.array([_numbers(path, i, row, width) for i, row in cells]).reshape(-1, width)
    found = _by_names(path, matrix, header) if header is not None else _by_width(str(path), matrix)
    stream = Stream(path.name, f"{len(matrix)} rows of {width}", len(found.points), np.nan, np.nan, "flowers")
    return found, [stream], "positions as CSV"


def _is_numeric(cells: list[str]) -> bool:
    try:
        _ = [float(cell or "nan") for cell in cells]
    except ValueError:
        return False
    return True


def _numbers(path: Path, row: int, cells: list[str], width: int) -> list[float]:
    if len(cells) != width:
        raise InputError(f"{path}: row {row}: {len(cells)} values, expected {width}")
    try:
        return [float(cell or "nan") for cell in cells]
    except ValueError:
        bad = next(cell for cell in cells if not _is_numeric([cell]))
        raise InputError(f"{path}: row {row}: {shown(bad)}, expected a number") from None


def _by_names(path: Path, matrix: Array, header: list[str]) -> Positions:
    """A table with a header: long with x, y, z, or wide with x1, y1, z1 and so on."""
    key = next((name for name in (*_TIMES, *_FRAMES) if name in header), None)
    first = None if key is None else matrix[:, header.index(key)]
    if all(name in header for name in "xyz"):
        xyz = matrix[:, [header.index(name) for name in "xyz"]]
        if first is None:
            raise InputError(
                f"{path}: row 1: no column for the frame, expected one of {', '.join((*_TIMES, *_FRAMES))}"
            )
        scores = matrix[:, header.index("score")] if "score" in header else None
        return _long(first, xyz, key in _TIMES, scores)
    wide = [k for k in range(len(header)) if header[k] != key]
    if len(wide) % 3 or not wide:
        raise InputError(f"{path}: row 1: columns {shown(','.join(header))}, expected x,y,z or x1,y1,z1,x2,y2,z2,...")
    return _wide(matrix[:, wide], first if key in _TIMES else None)


def _by_width(where: str, matrix: Array) -> Positions:
    """A matrix without names: 4 columns are long, 3 k are wide, 3 k + 1 are wide with the time first."""
    width = matrix.shape[1]
    if width == 4:
        is_time = bool((matrix[:, 0] != np.rint(matrix[:, 0])).any())
        return _long(matrix[:, 0], matrix[:, 1:], is_time, None)
    if width % 3 == 0 and width:
        return _wide(matrix, None)
    if width % 3 == 1 and width > 4:
        return _wide(matrix[:, 1:], matrix[:, 0])
    raise InputError(f"{where}: {width} columns, expected 4 (frame x y z), 3 k or 3 k + 1 (time x1 y1 z1 ...)")


def _long(first: Array, xyz: Array, is_time: bool, scores: Array | None) -> Positions:
    there = np.isfinite(xyz).all(axis=1) & np.isfinite(first)
    known, frame = np.unique(first[np.isfinite(first)], return_inverse=True)
    full = np.zeros(len(first), np.int64)
    full[np.isfinite(first)] = frame
    if not is_time:  # numbers of frames: those that saw nothing count too
        full[np.isfinite(first)] = np.rint(first[np.isfinite(first)] - known.min(initial=np.inf)).astype(np.int64)
    kept = None if scores is None else scores[there]
    return Positions(full[there], xyz[there], known if is_time else None, kept)


def _wide(matrix: Array, times: Array | None) -> Positions:
    points = matrix.reshape(len(matrix), -1, 3)
    there = np.isfinite(points).all(axis=2)
    frame, _ = np.nonzero(there)
    return Positions(frame.astype(np.int64), points[there], times)


# --- MATLAB


def _mat(path: Path, options: ImportOptions) -> tuple[Positions, list[Stream], str]:
    content = _load(path)
    names = [name for name in content if not name.startswith("__")]
    usable = [name for name in names if _as_positions(path, name, content[name]) is not None]
    chosen = choose(path, "variable", options.flowers, names, sorted(usable, key=lambda n: -np.size(content[n])))
    found = None if chosen is None else _as_positions(path, chosen, content[chosen])
    if chosen is None or found is None:
        listed = (
            ", ".join(f"{name if name.isidentifier() else shown(name)} {np.shape(content[name])}" for name in names)
            or "nothing"
        )
        raise InputError(f"{path}: no positions per frame in {chosen or listed}, expected a cell or array of x y z")
    n = int(found.frame.max(initial=-1)) + 1
    times = next((t for t in (_as_times(content[k], n) for k in names if k != chosen) if t is not None), found.times)
    length = n if times is None else len(times)
    poses = next((p for p in (_as_poses(content[k], length) for k in names if k != chosen) if p is not None), None)
    streams = [_stream(name, content[name], "flowers" if name == chosen else "") for name in names]
    return Positions(found.frame, found.points, times, found.scores, poses), streams, "positions as MATLAB file"


def _stream(name: str, value: Any, role: str) -> Stream:
    return Stream(name, "x".join(map(str, np.shape(value))), int(np.size(value)), np.nan, np.nan, role)


def _load(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        content: dict[str, Any] = loadmat(path, squeeze_me=False, struct_as_record=True)
    except FileNotFoundError:
        raise InputError(f"{path}: missing, expected a MATLAB file") from None
    except NotImplementedError:
        raise InputError(f"{path}: a MATLAB file of version 7.3 (HDF5), expected save(..., '-v7')") from None
    except Exception as error:  # of zlib, struct, NumPy or SciPy: whatever the damage leads to
        what = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: cannot be read as a MATLAB file ({what}); is it cut off?") from None
    return content


def _as_positions(path: Path, name: str, value: Any) -> Positions | None:
    """A variable as positions per frame; None where it is something else."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return _cells([np.asarray(cell) for cell in value.ravel()])
    if not (isinstance(value, np.ndarray) and value.dtype.kind in "fiu") or not value.size:
        return None
    array = value.astype(float)
    if array.ndim == 3 and array.shape[:2] != (4, 4):
        if array.shape[1] == 3:
            return _cells(list(np.moveaxis(array, 2, 0)))
        if array.shape[0] == 3:
            return _cells(list(np.moveaxis(array, (2, 1), (0, 1))))
        return None
    if array.ndim != 2 or array.shape[1] in (1, 7) or array.shape[0] == 1:
        return None
    try:
        return _by_width(f"{path}: {name}", array)
    except InputError:
        return None


def _cells(cells: list[Any]) -> Positions | None:
    """One matrix (n, 3) a frame, or (3, n); empty ones are frames without flowers.

    A (3, 3) is read as the others are, by rows where they do not say.
    """
    points, frames = [], []
    is_columns = any(cell.ndim == 2 and cell.shape[0] == 3 != cell.shape[1] and cell.size for cell in cells)
    for k, cell in enumerate(cells):
        if not cell.size:
            continue
        if cell.ndim != 2 or cell.dtype.kind not in "fiu" or 3 not in cell.shape:
            return None
        rows = (cell.T if is_columns else cell).astype(float)
        if rows.shape[1] != 3:
            return None
        rows = rows[np.isfinite(rows).all(axis=1)]
        points.append(rows)
        frames.append(np.full(len(rows), k, dtype=np.int64))
    if not points:
        return None
    return Positions(np.concatenate(frames), np.concatenate(points), None)


def _as_times(value: Any, n: int) -> Array | None:
    """A vector of at least n increasing numbers."""
    if not (isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.ndim == 2 and 1 in value.shape):
        return None
    times = value.astype(float).ravel()
    is_times = len(times) >= max(n, 2) and np.isfinite(times).all() and (np.diff(times) > 0).all()
    return times if is_times else None


def _as_poses(value: Any, n: int) -> Array | None:
    """Rows (n, 7): an array (n, 7) with unit quaternions last, or motions (4, 4, n)."""
    if not (isinstance(value, np.ndarray) and value.dtype.kind in "fiu"):
        return None
    array = value.astype(float)
    if array.shape == (n, 7) and np.allclose(np.linalg.norm(array[:, 3:], axis=1), 1.0, atol=0.01):
        return array
    if array.shape == (4, 4, n) and np.allclose(array[3].T, [0, 0, 0, 1], atol=1e-6):
        return tum_from_pose(np.moveaxis(array, 2, 0))
    return None
