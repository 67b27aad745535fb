"""A journal becomes a session: clocks fitted to the whole of it, each view with the robot's pose at its time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError, OutputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.importers.session_files import check_free, flowers_csv, image_list, trajectory
from cluster_slam.io.text import read_text
from cluster_slam.live.journal import FRAME_COLUMNS, ROBOT_COLUMNS, ROW_COLUMNS, journal_of
from cluster_slam.live.robot_poses import MAX_GAP_S
from cluster_slam.records import BoolArray
from cluster_slam.sensors.clock import Clock, ClockEstimator, fit_clock
from cluster_slam.sensors.interpolation import interpolate, pose_from_rotation_vector

_BLOCK_S = 600.0  # a quartz changes with its temperature: one line for so long


@dataclass(frozen=True, slots=True, eq=False)
class Finished:
    """What a recording holds."""

    n_samples: int
    n_views: int  # of the camera
    n_frames: int  # with a pose
    n_without_pose: int
    n_points: int
    clocks: tuple[Clock, ...]  # one for each stretch of the controller's clock
    losses: tuple[tuple[float, float], ...]  # begin (Unix time) and length of each silence of the robot, s


def finish(out: Path) -> Finished:
    """Make the session ``out`` of the journal beside it.

    Raises
    ------
    InputError
        There is no journal, or nothing in it.
    OutputError
        ``out`` is taken; the journal stays as it is.
    """
    journal = journal_of(out)
    if not journal.is_dir():
        raise InputError(f"{journal}: missing, expected an unfinished recording")
    check_free(out)
    robot = _numbers(journal / "robot.csv", ROBOT_COLUMNS)
    if not len(robot):
        raise InputError(f"{journal / 'robot.csv'}: row 1: no sample of the robot, expected at least one")
    times, poses, clocks = _on_this_clock(robot)
    frames = _numbers(journal / "frames.csv", FRAME_COLUMNS)
    has_camera = len(frames) > 0
    stamps = np.unique(frames[:, 0]) if has_camera else times
    known = _is_known(times, stamps)
    rows = tum_from_pose(interpolate(times, poses, stamps[known]))
    points = _numbers(journal / "rows.csv", ROW_COLUMNS)
    files = {"poses.txt": trajectory(stamps[known], rows), **_observations(journal, stamps[known], points)}
    try:
        for name, content in files.items():
            (journal / name).write_text(content, "utf-8")
        journal.rename(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); the recording stays in {journal}") from None
    n_kept = int(np.isin(points[:, 0], stamps[known]).sum()) if len(points) else 0
    silences = _silences(times)
    return Finished(len(robot), len(frames), int(known.sum()), int((~known).sum()), n_kept, clocks, silences)


def _observations(journal: Path, stamps: Array, points: Array) -> dict[str, str]:
    """``flowers.csv`` of the located rows, the rest beside it, and lists of the images, by name."""
    files = {}
    images = {folder: _images(journal / folder) for folder in ("rgb", "depth")}
    for folder, found in images.items():
        if found:
            names = [f"{folder}/{name}" for _, name in found]
            files[f"{folder}.txt"] = image_list(np.array([stamp for stamp, _ in found]), names)
    if len(points) or not images["rgb"]:
        is_located = np.isin(points[:, 0], stamps) if len(points) else np.zeros(0, bool)
        files["flowers.csv"] = _flowers(points[is_located])
        if not is_located.all():
            files["unlocated.csv"] = _flowers(points[~is_located])
    return files


def _flowers(rows: Array) -> str:
    covs = rows[:, [[5, 6, 7], [6, 8, 9], [7, 9, 10]]]
    return flowers_csv(rows[:, 0], rows[:, 1:4], covs=covs, scores=rows[:, 4])


def _images(folder: Path) -> list[tuple[float, str]]:
    """Stamps and names of images, the empty ones left out."""
    return sorted((float(path.stem), path.name) for path in folder.glob("*.png") if path.stat().st_size)


def _numbers(path: Path, columns: str) -> Array:
    """The complete rows (n, k) of a file that may have been cut off; empty cells are NaN."""
    width = columns.count(",") + 1
    *lines, _ = read_text(path, f"a table with the columns {columns}").split("\n")
    cells = [line.split(",") for line in lines[1:]]
    whole = [[float(cell or "nan") for cell in row] for row in cells if len(row) == width]
    return np.array(whole).reshape(-1, width)


def _on_this_clock(robot: Array) -> tuple[Array, Array, tuple[Clock, ...]]:
    """Times (n,) and poses (n, 4, 4) of the samples, by a line a stretch of the controller's clock."""
    begins = _stretches(robot)
    times, clocks = [], []
    for begin, end in zip(begins, [*begins[1:], len(robot)], strict=True):
        stamps, arrivals = robot[begin:end, 1], robot[begin:end, 0]
        clock = fit_clock(stamps, arrivals)
        clocks.append(clock)
        times.append(clock.arrival(stamps))
    all_times = np.concatenate(times)
    keep = np.concatenate([[True], all_times[1:] > np.maximum.accumulate(all_times)[:-1]])
    return all_times[keep], pose_from_rotation_vector(robot[keep, 2:8]), tuple(clocks)


def _stretches(robot: Array) -> list[int]:
    """Where (rows) a new line begins: a clock was set, or ten minutes are over."""
    estimator, begins = ClockEstimator(), [0]
    for i, (arrival, stamp) in enumerate(robot[:, :2].tolist()):
        if estimator.add(stamp, arrival) or stamp - robot[begins[-1], 1] > _BLOCK_S:
            begins.append(i)
    return begins


def _is_known(times: Array, stamps: Array) -> BoolArray:
    """Whether (n,) samples lie around each stamp, close to each other."""
    i = np.searchsorted(times, stamps)
    before, after = np.clip(i - 1, 0, len(times) - 1), np.clip(i, 0, len(times) - 1)
    is_hit = times[after] == stamps
    is_between = (i > 0) & (i < len(times)) & (times[after] - times[before] <= MAX_GAP_S)
    known: BoolArray = is_hit | is_between
    return known


def _silences(times: Array) -> tuple[tuple[float, float], ...]:
    gaps = np.diff(times)
    return tuple((float(times[i]), float(gaps[i])) for i in np.flatnonzero(gaps > MAX_GAP_S))
