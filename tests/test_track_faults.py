"""What can go wrong around ``track``: a full disk, Ctrl-C, a reader that hangs, a live source that gives nonsense."""

from __future__ import annotations

import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cluster_slam import track
from cluster_slam.cli.app import run
from cluster_slam.errors import InputError
from cluster_slam.io.session_writer import write_session
from cluster_slam.live.replay import Replay
from cluster_slam.live.view import Notice, NoticeKind
from cluster_slam.online.journal import journal_of, read_journal
from cluster_slam.pipeline.track import track_source
from cluster_slam.records import Frame
from cluster_slam.simulate import PRESETS, Simulated, simulate_session


@cache
def made() -> Simulated:
    return simulate_session(replace(PRESETS["sample"], duration_s=4.0), seed=9)


def command(tmp_path: Path, *options: str) -> list[str]:
    folder = tmp_path / "session"
    if not folder.exists():
        write_session(folder, made().session, made().truth)
    program = [sys.executable, "-m", "cluster_slam.cli", "track", str(folder), "-o", str(tmp_path / "out")]
    return [*program, "--quiet", *options]


def test_a_full_disk_ends_it_with_one_line_and_it_goes_on_when_there_is_room(tmp_path: Path) -> None:
    def small_disk() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000))

    words = command(tmp_path)
    ended = subprocess.run(words, preexec_fn=small_disk, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2
    assert len(ended.stderr.splitlines()) == 1
    assert "cannot be written (File too large)" in ended.stderr
    assert not (tmp_path / "out").exists()
    journal = journal_of(tmp_path / "out")
    assert len(read_journal(journal).frames) > 0
    if (journal / "mark.bin").exists():
        assert run([*words[3:], "--resume"]) == 0


def test_ctrl_c_ends_after_a_frame_and_the_run_can_go_on(tmp_path: Path) -> None:
    process = subprocess.Popen(command(tmp_path, "--realtime"), stderr=subprocess.PIPE, text=True)
    frames = journal_of(tmp_path / "out") / "frames.bin"
    end = time.monotonic() + 60
    while not (frames.exists() and (frames.parent / "mark.bin").exists()):
        assert time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "--resume goes on from there" in said
    assert "Traceback" not in said
    assert run([*command(tmp_path, "--resume")[3:]]) == 0
    rows = (tmp_path / "out" / "observations.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[1]) for row in rows] == track(made().session).flower_ids.tolist()


def test_a_reader_that_never_reads_cannot_hold_it_up(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        stream = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        begun = time.monotonic()
        ended = subprocess.run(
            command(tmp_path, "--realtime", "--stream", stream), capture_output=True, text=True, timeout=120
        )
        assert time.monotonic() - begun < 60
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "out" / "report.html").exists()


class Source:
    """A live source that yields what it is given, and says that something happened."""

    def __init__(self, given: list[Frame]) -> None:
        self.header, self._given = Replay(made().session).header, given

    def frames(self) -> Iterator[Frame]:
        return iter(self._given)

    def notices(self) -> list[Notice]:
        return [Notice(0.0, NoticeKind.ROBOT, "lost: nobody answers")]


@pytest.fixture
def given() -> list[Frame]:
    return list(Replay(made().session).frames())


def test_a_clock_that_jumps_back_loses_no_rows(tmp_path: Path, given: list[Frame]) -> None:
    """Five frames show that the clock was set; all others are in the tables, on a time that runs on."""
    late = [replace(frame, stamp=frame.stamp - 100.0) for frame in given[30:]]
    result = track_source(Source([*given[:30], *late]), tmp_path / "out")
    assert result.session.n_frames == len(given) - 4
    assert (np.diff(result.session.stamps) > 0).all()
    assert any("clock jumped back by" in text for text in result.warnings)
    assert any("robot: lost" in text for text in result.warnings)


def test_rows_that_are_no_points_are_left_out_of_the_tables(tmp_path: Path, given: list[Frame]) -> None:
    points = given[10].points.copy()
    points[2] = np.nan
    bad = replace(given[10], points=points)
    result = track_source(Source([*given[:10], bad, *given[11:]]), tmp_path / "out")
    seen = result.session.observations
    assert len(seen) == sum(map(len, given)) - 1
    assert np.isfinite(seen.points).all()
    assert len(result.flower_ids) == len(seen)
    assert "rows that are no points were left out" in result.warnings


def test_a_robot_without_a_pose_costs_its_frames_only(tmp_path: Path, given: list[Frame]) -> None:
    lost = [replace(frame, pose=np.full((4, 4), np.nan)) for frame in given[20:30]]
    result = track_source(Source([*given[:20], *lost, *given[30:]]), tmp_path / "out")
    assert result.session.n_frames == len(given) - 10
    assert sum("pose is not finite" in text for text in result.warnings) == 1


def test_a_mount_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    session = made().session
    unknown = replace(session, noise=replace(session.noise, hand_eye_rotation=3.0, hand_eye_translation=1.0))
    with pytest.raises(InputError, match=r"only known to 1 m and 3 rad, expected --calibration FILE"):
        track(unknown, out=tmp_path / "out")
    assert not list(tmp_path.iterdir())
