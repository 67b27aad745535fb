"""RTDE logs, and positions per frame as .csv and .mat: each from its own ecosystem's writer, read back exactly."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rtde_help import SPEED, UPTIME, EmulatedRobot, line_motion
from scipy.io import savemat

from cluster_slam.cli.app import run
from cluster_slam.errors import InputError
from cluster_slam.io.importers.poses import log_stamps, read_pose_file
from cluster_slam.io.importers.rtde_csv import read_rtde_csv
from cluster_slam.io.importers.session_files import flowers_csv, trajectory
from cluster_slam.io.session import open_session
from cluster_slam.live.motion_file import read_motion
from cluster_slam.sensors.interpolation import rotation_vector_from_pose

POINTS = [np.random.default_rng(k).normal(size=(n, 3)) for k, n in enumerate((3, 0, 2, 4))]
ALL = np.concatenate(POINTS)
FRAMES = np.repeat(np.arange(4), [len(p) for p in POINTS])


def imported(source: Path, *options: str) -> Any:
    """The session of a source."""
    out = source.parent / "session"
    assert run(["import", str(source), "-o", str(out), "--quiet", *options]) == 0
    return open_session(out)


# --- RTDE logs

HEADER = ["timestamp", *(f"actual_TCP_pose_{i}" for i in range(6)), *(f"actual_q_{i}" for i in range(6)), "robot_mode"]


def rtde_rows(n: int = 20) -> list[list[float]]:
    """x = 0.01 k at 25 Hz."""
    return [[1000 + 0.04 * k, 0.01 * k, 0, 0.5, 0, 0, 0.02 * k, *[0.1 * k] * 6, 7] for k in range(n)]


@pytest.mark.parametrize("separator", [",", " ", ";"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_logs_with_any_separator_and_line_end(tmp_path: Path, separator: str, end: str) -> None:
    lines = [separator.join(HEADER), *(separator.join(map(repr, row)) for row in rtde_rows()), ""]
    (tmp_path / "log.csv").write_bytes(end.join(lines).encode())
    log = read_rtde_csv(tmp_path / "log.csv")
    rows = np.array(rtde_rows())
    assert np.array_equal(log.stamps, rows[:, 0])
    assert np.array_equal(log.columns["actual_TCP_pose"], rows[:, 1:7])
    assert np.array_equal(log.columns["actual_q"], rows[:, 7:13])
    assert np.array_equal(log.columns["robot_mode"], rows[:, 13:])
    assert log.host is None


@pytest.mark.parametrize("name", ["time", "_id"])
def test_dates_of_the_host_bring_the_log_to_unix_time(tmp_path: Path, name: str) -> None:
    """The controller's stamps count from its start; a date a row, late by 1 to 5 ms, tells Unix time to a millisecond.
    A real logger writes the date under ``_id``.
    """
    rng = np.random.default_rng(3)
    rows = rtde_rows(50)
    late = rng.uniform(0.001, 0.005, len(rows))
    late[10] = 0.001
    base = 1_633_435_693.0  # 2021-10-05 12:08:13 UTC
    dates = [base + row[0] - 1000 + d for row, d in zip(rows, late, strict=True)]
    other = "_id" if name == "time" else "time"
    words = [datetime.fromtimestamp(t, UTC).strftime("%Y:%m:%d:%H:%M:%S.%f") for t in dates]
    lines = [",".join([name, other, *HEADER])]
    lines += [",".join([w, str(k), *map(repr, row)]) for k, (w, row) in enumerate(zip(words, rows, strict=True))]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    log = read_rtde_csv(tmp_path / "log.csv")
    assert log_stamps(log) == pytest.approx(base + 0.001 + 0.04 * np.arange(50), abs=2e-6)


def test_a_log_as_a_session(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("\n".join([",".join(HEADER), *(",".join(map(repr, r)) for r in rtde_rows())]))
    session = imported(tmp_path / "log.csv", "--hand-eye", "0 0 0.05 0 0 0 1")
    assert session.pose_frame == "T_world_flange"
    rows = np.array(rtde_rows())
    assert np.array_equal(session.stamps, rows[:, 0])
    assert np.abs(rotation_vector_from_pose(session.poses) - rows[:, 1:7]).max() < 1e-12


def test_ur_rtdes_own_recorder(tmp_path: Path) -> None:
    """``startFileRecording`` of the real client, from the emulator: six decimals, rows doubled by its own clock."""
    path = tmp_path / "recorded.csv"
    code = (
        "import sys, time; from rtde_receive import RTDEReceiveInterface as R; r = R(sys.argv[1], 125.0); "
        f"r.startFileRecording({str(path)!r}, ['timestamp', 'actual_TCP_pose', 'actual_q']); time.sleep(1.2); "
        "r.stopFileRecording()"
    )
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        subprocess.run([sys.executable, "-c", code, robot.host], check=True, timeout=30, capture_output=True)
    log = read_rtde_csv(path)
    assert len(log.stamps) > 50
    off = np.abs(log.columns["actual_TCP_pose"][:, 0] - SPEED * (log.stamps - UPTIME))
    assert (off < 2e-6).mean() > 0.9
    assert off.max() < 2.1 * 0.008 * SPEED  # the recorder's own rows may be torn between two packages


def test_the_real_recordings(tmp_path: Path) -> None:
    folder = Path(os.environ.get("CLUSTER_SLAM_DATA", "nowhere")) / "rtde" / "ur3e"
    if not folder.is_dir():
        pytest.skip("no real RTDE logs (CLUSTER_SLAM_DATA)")
    for path in sorted(folder.glob("*.csv")):
        log = read_rtde_csv(path)
        assert log.host is not None
        assert np.median(np.diff(log.stamps)) == pytest.approx(0.04, abs=0.002)
        assert np.abs(log_stamps(log) - log.host).max() < 0.1
        assert read_motion(path).duration_s == pytest.approx(log.stamps[-1] - log.stamps[0])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda rows: [*rows[:5], rows[5].replace("7", "x"), *rows[6:]], "row 6: .* expected a finite number"),
        (lambda rows: [*rows[:5], *rows[2:]], "expected a later one"),
        (lambda rows: rows[:1], "expected a header and rows"),
        (lambda rows: ["time" + rows[0][9:], *rows[1:]], "no column 'timestamp'"),
        (lambda rows: [rows[0], *(row[:30] for row in rows[1:])], "expected 14"),
    ],
)
def test_logs_that_are_not_as_they_should_be(
    tmp_path: Path, change: Callable[[list[str]], list[str]], match: str
) -> None:
    rows = [",".join(HEADER), *(",".join(map(repr, row)) for row in rtde_rows())]
    (tmp_path / "log.csv").write_text("\n".join(change(rows)))
    with pytest.raises(InputError, match=match):
        read_rtde_csv(tmp_path / "log.csv")


def test_a_last_row_that_is_cut_off_is_left_out(tmp_path: Path) -> None:
    rows = [",".join(HEADER), *(",".join(map(repr, row)) for row in rtde_rows())]
    (tmp_path / "log.csv").write_text("\n".join(rows)[:-30])
    log = read_rtde_csv(tmp_path / "log.csv")
    assert len(log.stamps) == 19
    assert "left out" in log.warnings[0]


# --- positions as CSV


def check_points(session: Any, *, is_exact: bool = True) -> None:
    """The session has POINTS, bit by bit where nothing was scaled."""
    seen = session.observations
    assert np.array_equal(seen.frame, FRAMES)
    assert np.array_equal(seen.points, ALL) if is_exact else seen.points == pytest.approx(ALL)


def test_long_tables(tmp_path: Path) -> None:
    """``frame,x,y,z``; frame 2 saw nothing and is there all the same."""
    rows = [f"{k + 1},{x!r},{y!r},{z!r}" for k, (x, y, z) in zip(FRAMES.tolist(), ALL.tolist(), strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["frame,x,y,z", *rows]))
    session = imported(tmp_path / "p.csv", "--rate", "10")
    check_points(session)
    assert np.array_equal(session.stamps, np.arange(4) / 10)


def test_long_tables_with_times_and_scores(tmp_path: Path) -> None:
    stamps = np.array([5.5, 5.6, 5.8, 5.9])[FRAMES]
    rows = [f"{t!r},{x!r},{y!r},{z!r},0.5" for t, (x, y, z) in zip(stamps.tolist(), ALL.tolist(), strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["Time,X,Y,Z,Score", *rows]))
    session = imported(tmp_path / "p.csv")
    assert np.array_equal(session.stamps, [5.5, 5.8, 5.9])
    assert np.array_equal(session.observations.points, ALL)
    assert (session.observations.scores == 0.5).all()


def wide() -> np.ndarray:
    """A row a frame, x y z of each flower, NaN where there is none."""
    out = np.full((4, 12), np.nan)
    for k, points in enumerate(POINTS):
        out[k, : 3 * len(points)] = points.ravel()
    return out


@pytest.mark.parametrize("empty", ["NaN", ""])
def test_wide_tables(tmp_path: Path, empty: str) -> None:
    """As ``writematrix`` has it, and with a time first."""
    body = [",".join(empty if x != x else repr(x) for x in row) for row in wide().tolist()]
    (tmp_path / "p.csv").write_text("\n".join(body))
    check_points(imported(tmp_path / "p.csv"))
    (tmp_path / "session").rename(tmp_path / "first")
    (tmp_path / "p.csv").write_text("\n".join(f"{7 + 0.5 * k},{line}" for k, line in enumerate(body)))
    session = imported(tmp_path / "p.csv")
    check_points(session)
    assert np.array_equal(session.stamps, [7.0, 7.5, 8.0, 8.5])


def test_millimetres_are_seen(tmp_path: Path) -> None:
    body = [",".join("NaN" if x != x else repr(1000 * x) for x in row) for row in wide().tolist()]
    (tmp_path / "p.csv").write_text("\n".join(body))
    check_points(imported(tmp_path / "p.csv"), is_exact=False)
    (tmp_path / "session").rename(tmp_path / "first")
    session = imported(tmp_path / "p.csv", "--unit", "m")
    assert session.observations.points == pytest.approx(1000 * ALL)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "empty"),
        ("frame,x,y\n1,2,3\n", "expected x,y,z"),
        ("x,y,z\n1,2,3\n", "no column for the frame"),
        ("1,2,3,4\n1,2,3\n", "row 2: 3 values, expected 4"),
        ("1,2,3,4\n1,2,3,q\n", "row 2: 'q'"),
        ("1,2\n3,4\n", "2 columns, expected 4"),
    ],
)
def test_tables_that_are_not_positions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, match: str
) -> None:
    (tmp_path / "p.csv").write_text(text)
    assert run(["import", str(tmp_path / "p.csv"), "-o", str(tmp_path / "s")]) == 2
    error = capsys.readouterr().err
    assert match in error
    assert len(error.splitlines()) == 1
    assert not (tmp_path / "s").exists()


# --- MATLAB


def cell(parts: list[np.ndarray]) -> np.ndarray:
    """A MATLAB cell."""
    out = np.empty((len(parts), 1), dtype=object)
    for k, part in enumerate(parts):
        out[k, 0] = part
    return out


def cube(parts: list[np.ndarray]) -> np.ndarray:
    """(n, 3, frames) with NaN where there is no flower."""
    out = np.full((max(map(len, parts)), 3, len(parts)), np.nan)
    for k, part in enumerate(parts):
        out[: len(part), :, k] = part
    return out


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    "value",
    [
        cell(POINTS),
        cell([p.T for p in POINTS]),
        cube(POINTS),
        np.moveaxis(cube(POINTS), (0, 1), (1, 0)),
        np.column_stack([FRAMES + 1, ALL]),
        wide(),
    ],
    ids=["cell", "cell of columns", "cube", "cube of columns", "long", "wide"],
)
def test_variables_of_matlab(tmp_path: Path, value: np.ndarray, compressed: bool) -> None:
    """One cell is (3, 3): whether its rows or its columns are flowers, the others say."""
    savemat(tmp_path / "p.mat", {"flowers": value, "note": "a text"}, do_compression=compressed)
    check_points(imported(tmp_path / "p.mat"))


def test_times_and_poses_beside_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    q = rng.normal(size=(4, 4))
    rows = np.column_stack([rng.normal(size=(4, 3)), q / np.linalg.norm(q, axis=1, keepdims=True)])
    times = np.array([[3.25], [3.5], [4.0], [4.125]])
    savemat(tmp_path / "p.mat", {"points": cell(POINTS), "t": times, "poses": rows})
    session = imported(tmp_path / "p.mat")
    check_points(session)
    assert np.array_equal(session.stamps, times.ravel())
    assert np.array_equal(read_pose_file(tmp_path / "session" / "poses.txt", 0.0)[1], rows)


def test_motions_of_matlab(tmp_path: Path) -> None:
    from cluster_slam.geometry import se3_exp

    T = se3_exp(np.random.default_rng(9).normal(size=(4, 6)))
    savemat(tmp_path / "p.mat", {"points": cell(POINTS), "T": np.moveaxis(T, 0, 2)})
    assert np.abs(imported(tmp_path / "p.mat").poses - T).max() < 1e-12


def test_a_variable_is_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    savemat(tmp_path / "p.mat", {"a": cell(POINTS), "b": cell([2 * p for p in POINTS])})
    session = imported(tmp_path / "p.mat", "--flowers", "b")
    assert np.array_equal(session.observations.points, 2 * ALL)
    assert run(["import", str(tmp_path / "p.mat"), "-o", str(tmp_path / "x"), "--flowers", "c"]) == 2
    assert "no variable 'c', expected one of a, b" in capsys.readouterr().err
    assert run(["import", str(tmp_path / "p.mat"), "--dry-run", "--json"]) == 0
    names = [s["name"] for s in json.loads(capsys.readouterr().out)["streams"]]
    assert names == ["a", "b"]


@pytest.mark.parametrize("share", [0.0, 0.4, 0.8])
def test_a_mat_file_that_is_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str], share: float) -> None:
    path = tmp_path / "p.mat"
    savemat(path, {"flowers": np.random.default_rng(1).normal(size=(50, 4))}, do_compression=True)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert run(["import", str(path), "-o", str(tmp_path / "s")]) == 2
    error = capsys.readouterr().err
    assert "p.mat" in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize("at", [0, 100, 130, 140, 180, -20])
def test_a_mat_file_that_is_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str], at: int) -> None:
    """Zeros somewhere in a compressed file: refused in one line, or read where they did no harm."""
    path = tmp_path / "p.mat"
    savemat(path, {"flowers": cell(POINTS)}, do_compression=True)
    data = bytearray(path.read_bytes())
    at %= len(data)
    data[at : at + 15] = b"\0" * 15
    path.write_bytes(bytes(data))
    code = run(["import", str(path), "-o", str(tmp_path / "s"), "--quiet"])
    assert code == (0 if at == 100 else 2)
    assert len(capsys.readouterr().err.splitlines()) == (0 if code == 0 else 1)


def test_mat_files_without_positions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    savemat(tmp_path / "p.mat", {"name": "x", "gain": 3.0})
    assert run(["import", str(tmp_path / "p.mat"), "-o", str(tmp_path / "s")]) == 2
    assert "no positions per frame in name (1,), gain (1, 1)" in capsys.readouterr().err
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "v.mat").write_bytes(head + b"\x89HDF\r\n\x1a\n" + b"\0" * 500)
    assert run(["import", str(tmp_path / "v.mat"), "-o", str(tmp_path / "s")]) == 2
    assert "7.3" in capsys.readouterr().err


# --- what is written reads back

NUMBER = st.floats(-1e6, 1e6, allow_nan=False)


@given(st.lists(st.tuples(*[NUMBER] * 3), min_size=1, max_size=5))
def test_numbers_are_written_so_that_they_read_back(points: list[tuple[float, float, float]]) -> None:
    rows = np.array(points)
    stamps = np.arange(len(rows)) / 3
    lines = flowers_csv(stamps, rows).splitlines()[1:]
    assert np.array_equal([[float(x) for x in line.split(",")] for line in lines], np.column_stack([stamps, rows]))
    poses = np.column_stack([rows, rows, rows[:, 0]])
    lines = trajectory(stamps, poses).splitlines()[1:]
    assert np.array_equal([[float(x) for x in line.split()] for line in lines], np.column_stack([stamps, poses]))
