"""The live tracker under fire: broken frames, broken clocks, broken disks, and going on after a kill."""

from __future__ import annotations

import json
import os
import pickle
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

from cluster_slam import OnlineTracker, track
from cluster_slam.cli.app import run
from cluster_slam.errors import ConfigError, InputError, OutputError
from cluster_slam.geometry import inverse, se3_log
from cluster_slam.graph.incremental import FrameMatches, IncrementalMap, eliminate
from cluster_slam.io.session_writer import write_session
from cluster_slam.live.replay import Replay
from cluster_slam.online.journal import Journal, journal_of, read_journal, resume
from cluster_slam.online.pose import solve_pose
from cluster_slam.online.records import Update
from cluster_slam.online.stream import Stream, line, open_stream
from cluster_slam.pipeline.track import StoppedError, track_source
from cluster_slam.records import Frame
from cluster_slam.simulate import PRESETS, Simulated, simulate_session


@cache
def made() -> Simulated:
    return simulate_session(replace(PRESETS["sample"], duration_s=6.0), seed=9)


def frames(n: int | None = None) -> list[Frame]:
    return list(Replay(made().session).frames())[:n]


def tracker() -> OnlineTracker:
    session = made().session
    return OnlineTracker(session.noise, session.T_flange_camera)


def steps(given: list[Frame]) -> tuple[OnlineTracker, list[Update]]:
    t = tracker()
    return t, [t.step(f) for f in given]


def is_sound(t: OnlineTracker) -> None:
    """All that the tracker knows is finite, and its covariances are some."""
    table = t.world.flowers
    assert np.isfinite(table.place).all()
    assert (np.linalg.eigvalsh(table.cov)[:, 0] > 0).all() if len(table) else True
    tracks = t.tracks()
    assert (np.linalg.eigvalsh(tracks.covs)[:, 0] > 0).all() if len(tracks) else True
    assert len(np.unique(table.ids)) == len(table)
    assert len(np.unique(tracks.ids)) == len(tracks)
    assert set(table.slot.tolist()) == set(range(len(tracks)))


# --- frames as they should not be


def test_late_and_doubled_frames_change_nothing() -> None:
    given = frames(40)
    _, plain = steps(given)
    t, mixed = steps([*given[:20], given[10], given[19], *given[20:]])
    assert [u.is_accepted for u in mixed[20:22]] == [False, False]
    assert "late" in mixed[20].reason
    assert "already" in mixed[21].reason
    np.testing.assert_array_equal(mixed[-1].flower_ids, plain[-1].flower_ids)
    np.testing.assert_array_equal(mixed[-1].T_world_camera, plain[-1].T_world_camera)
    is_sound(t)


def test_a_clock_that_was_set_back_is_followed() -> None:
    given = frames(60)
    back = [replace(f, stamp=f.stamp - 100.0) for f in given[30:]]
    t, updates = steps([*given[:30], *back])
    refused = [u for u in updates if not u.is_accepted]
    assert 1 <= len(refused) <= 6
    assert any("clock jumped back" in w for u in updates for w in u.warnings)
    assert updates[-1].is_accepted
    known = {i for u in updates[20:30] for i in u.flower_ids.tolist()} - {-1}
    assert len(known & set(updates[-1].flower_ids.tolist())) >= 3
    is_sound(t)


def test_a_minute_without_frames_or_flowers_keeps_identities() -> None:
    given = frames(60)
    gap = [replace(f, stamp=f.stamp + 60.0) for f in given[30:]]
    empty = [
        replace(given[30], stamp=given[29].stamp + k, points=np.zeros((0, 3)), covs=np.zeros((0, 3, 3)), scores=None)
        for k in range(1, 60)
    ]
    for between in ([], empty):
        t, updates = steps([*given[:30], *between, *gap])
        before = {i for u in updates[20:30] for i in u.cluster_ids.tolist()} - {-1}
        after = {i for u in updates[-10:] for i in u.cluster_ids.tolist()} - {-1}
        assert len(before & after) >= len(before) - 1
        is_sound(t)


def test_a_flood_of_points_is_survived() -> None:
    given, rng = frames(40), np.random.default_rng(3)
    points = rng.uniform([-0.3, -0.2, 0.3], [0.3, 0.2, 0.8], (500, 3))
    flood = replace(given[20], points=points, covs=np.tile(1e-6 * np.eye(3), (500, 1, 1)), scores=None)
    t, updates = steps([*given[:20], flood, *given[21:]])
    assert len(updates[20].flower_ids) == 500
    before = {i for u in updates[10:20] for i in u.cluster_ids.tolist()} - {-1}
    after = {i for u in updates[-5:] for i in u.cluster_ids.tolist()} - {-1}
    assert before
    assert before <= after
    is_sound(t)


@pytest.mark.parametrize("kind", ["point", "cov", "negative", "behind", "pose", "mirror", "stamp"])
def test_what_is_no_number_is_left_out(kind: str) -> None:
    given = frames(30)
    bad = given[15]
    points, covs, pose = bad.points.copy(), bad.covs.copy(), bad.pose.copy()
    if kind == "point":
        points[0] = np.nan
    elif kind == "cov":
        covs[0, 0, 0] = np.inf
    elif kind == "negative":
        covs[0] = -covs[0]
    elif kind == "behind":
        points[0, 2] = -0.5
    elif kind == "pose":
        pose[0, 3] = np.nan
    elif kind == "mirror":
        pose[:3, 0] *= -1
    stamp = float("nan") if kind == "stamp" else bad.stamp
    t, updates = steps([*given[:15], Frame(stamp, pose, points, covs), *given[16:]])
    if kind in ("pose", "mirror", "stamp"):
        assert not updates[15].is_accepted
        assert updates[15].warnings
    else:
        assert updates[15].flower_ids[0] == -1
        assert "no points" in updates[15].warnings[0]
    assert updates[-1].is_accepted
    is_sound(t)


def test_random_damage_never_spoils_the_state() -> None:
    rng = np.random.default_rng(8)
    t, time_now = tracker(), 0.0
    for f in frames():
        kind = rng.integers(12)
        points, covs = f.points.copy(), f.covs.copy()
        if len(points) and kind < 3:
            points[rng.integers(len(points))] = [np.nan, 1e9, -1.0][kind]
        elif kind == 3:
            points, covs = points + 10.0, covs * 1e-12
        elif kind == 4:
            points, covs = np.tile(points[:1], (40, 1)), np.tile(covs[:1], (40, 1, 1))
        elif kind == 5:
            covs = covs * 1e6
        time_now = f.stamp + (rng.normal() if kind == 6 else 0.0)
        update = t.step(Frame(time_now, f.pose, points, covs))
        assert len(update.flower_ids) == len(points)
        is_sound(t)


# --- the parts


def matches(rng: np.random.Generator, ids: list[int], places: np.ndarray, stamp: float) -> FrameMatches:
    q = len(ids)
    J = rng.normal(size=(q, 3, 6))
    A = rng.normal(size=(q, 3, 3))
    return FrameMatches(
        stamp=stamp,
        ids=np.array(ids),
        points=places[ids] + 0.01 * rng.normal(size=(q, 3)),
        J=J,
        J_x=J,
        W=1e4 * (A @ np.swapaxes(A, 1, 2) + np.eye(3)),
        cluster=np.array(ids) // 2,
        sway_var=np.full(q, 1e-4),
        z=0.001 * rng.normal(size=6),
        prior=1e5 * np.eye(6),
    )


def dense_solution(frames: list[FrameMatches], prior: np.ndarray, n: int) -> np.ndarray:
    """All unknowns at once, by least squares: hand-eye tangent, places, and poses and displacements of all frames."""
    rows, rhs = [np.eye(6) @ np.linalg.cholesky(prior).T], [np.zeros(6)]
    size = 6 + 3 * n + sum(6 + 3 * len(np.unique(m.cluster)) for m in frames)
    blocks = [np.hstack([rows[0], np.zeros((6, size - 6))])]
    at = 6 + 3 * n
    for m in frames:
        clusters, s = np.unique(m.cluster, return_inverse=True)
        for k, flower in enumerate(m.ids):
            root = np.linalg.cholesky(m.W[k]).T
            A = np.zeros((3, size))
            A[:, :6], A[:, 6 + 3 * flower : 9 + 3 * flower] = -m.J_x[k], np.eye(3)
            A[:, at : at + 6], A[:, at + 6 + 3 * s[k] : at + 9 + 3 * s[k]] = -m.J[k], np.eye(3)
            blocks.append(root @ A)
            rhs.append(root @ m.points[k])
        A = np.zeros((6, size))
        root = np.linalg.cholesky(m.prior).T
        A[:, at : at + 6] = root
        blocks.append(A)
        rhs.append(-root @ m.z)
        for j in range(len(clusters)):
            A = np.zeros((3, size))
            A[:, at + 6 + 3 * j : at + 9 + 3 * j] = np.eye(3) / np.sqrt(m.sway_var[s == j][0])
            blocks.append(A)
            rhs.append(np.zeros(3))
        at += 6 + 3 * len(clusters)
    return np.linalg.lstsq(np.vstack(blocks), np.concatenate(rhs), rcond=None)[0]


def test_the_incremental_map_is_the_batch_solution() -> None:
    """Frames eliminated one by one give what all unknowns solved at once give; undone frames leave no trace."""
    rng = np.random.default_rng(2)
    places = rng.normal(size=(5, 3))
    looks = [sorted(rng.choice(5, 4, replace=False).tolist()) for _ in range(12)]
    given = [matches(rng, ids, places, 0.1 * i) for i, ids in enumerate(looks)]
    prior = 1e4 * np.eye(6)
    built = IncrementalMap(prior, window_s=10.0)
    for j in range(5):
        built.include(j, places[j], 1e6 * np.eye(3), np.zeros((3, 6)))
    wrong = matches(rng, [0, 1, 2], places[::-1], 0.55)
    for m in given[:6]:
        built.add(m)
    built.add(wrong)
    for m in given[6:]:
        built.add(m)
    built.replace(wrong, wrong.only(np.zeros(3, dtype=bool)))
    x, solved, cov = built.solve()
    exact = dense_solution(given, prior, 5)
    np.testing.assert_allclose(x, exact[:6], atol=1e-6)
    np.testing.assert_allclose(solved.ravel(), exact[6:21], atol=1e-5)
    assert np.linalg.eigvalsh(cov)[0] > 0
    again = pickle.loads(pickle.dumps(built))
    np.testing.assert_allclose(again.solve()[1], solved, atol=1e-12)


def test_one_flower_under_two_names_is_one_after_a_merge() -> None:
    rng = np.random.default_rng(5)
    places = rng.normal(size=(3, 3))
    one, two = (IncrementalMap(None, window_s=0.0) for _ in range(2))
    for j in range(3):
        one.include(j, places[j], 1e6 * np.eye(3), np.zeros((3, 6)))
    for j in (0, 1, 2, 7):
        two.include(j, places[j % 6 % 3], 2e6 * np.eye(3), np.zeros((3, 6)))
    first, second = matches(rng, [0, 1], places, 0.0), matches(rng, [1, 2], places, 1.0)
    for m in (first, second):
        one.add(m)
    two.add(first)
    two.add(replace(second, ids=np.array([7, 2])))
    two.merge(7, 1)
    np.testing.assert_allclose(two.solve()[1], one.solve()[1], atol=1e-4)


def test_near_solutions_converge_to_the_whole() -> None:
    rng = np.random.default_rng(7)
    places = rng.normal(size=(6, 3))
    built = IncrementalMap(None, window_s=0.0)
    for j in range(6):
        built.include(j, places[j], 1e2 * np.eye(3), np.zeros((3, 6)))
    for i in range(15):
        built.add(matches(rng, sorted(rng.choice(6, 3, replace=False).tolist()), places, float(i)))
    now, exact = places.copy(), built.solve()[1]
    for i in range(300):
        part = np.array([i % 6, (i + 1) % 6, (i + 2) % 6])
        now[part] = built.solve_near(part, now)[0]
    np.testing.assert_allclose(now, exact, atol=1e-6)


def test_pose_and_displacements_agree_with_all_solved_at_once() -> None:
    rng = np.random.default_rng(11)
    q, slot = 7, np.array([0, 0, 1, 1, 1, 2, 2])
    J, r = rng.normal(size=(q, 3, 6)), 0.01 * rng.normal(size=(q, 3))
    A = rng.normal(size=(q, 3, 3))
    W, P = 1e4 * (A @ np.swapaxes(A, 1, 2) + np.eye(3)), np.stack([s * np.eye(3) for s in (1e-5, 1e-4, 1e-3)])
    prior = 1e4 * np.eye(6)
    found = solve_pose(J, r, W, slot, P, prior, n_iterations=1)
    H, g = np.zeros((15, 15)), np.zeros(15)
    H[:6, :6] = prior
    for j in range(3):
        H[6 + 3 * j : 9 + 3 * j, 6 + 3 * j : 9 + 3 * j] = np.linalg.inv(P[j])
    for k in range(q):
        row = np.zeros((3, 15))
        row[:, :6], row[:, 6 + 3 * slot[k] : 9 + 3 * slot[k]] = J[k], -np.eye(3)
        H += row.T @ W[k] @ row
        g += row.T @ W[k] @ r[k]
    cov = np.linalg.inv(H)
    np.testing.assert_allclose(found.z, (cov @ g)[:6], atol=1e-12)
    np.testing.assert_allclose(found.cov, cov[:6, :6], rtol=1e-9)
    # a cluster's posterior is its prior updated with what it was measured to be against all others
    for j in range(3):
        gain = P[j] @ np.linalg.inv(P[j] + found.shift_cov[j])
        at = slice(6 + 3 * j, 9 + 3 * j)
        np.testing.assert_allclose(gain @ found.shift[j], (cov @ g)[at], atol=1e-10)
        np.testing.assert_allclose(P[j] - gain @ P[j], cov[at, at], rtol=1e-6, atol=1e-12)


def test_elimination_needs_no_order() -> None:
    rng = np.random.default_rng(1)
    m = matches(rng, [4, 1, 3], rng.normal(size=(5, 3)), 0.0)
    a, b = eliminate(m), eliminate(m.only(np.array([True, True, True])))
    np.testing.assert_allclose(a.H, b.H)
    np.testing.assert_allclose(a.H, a.H.T, atol=1e-6)


# --- the journal


def test_a_run_goes_on_from_its_mark_as_if_nothing_had_been(tmp_path: Path) -> None:
    session = made().session
    whole = track(session)
    out = tmp_path / "out"
    n_seen = 0

    def stop() -> bool:
        nonlocal n_seen
        n_seen += 1
        return n_seen == 50

    with pytest.raises(StoppedError, match="50 of 90"):
        track(session, out=out, should_stop=stop)
    assert journal_of(out).is_dir()
    again = track(session, out=out, resume=True)
    np.testing.assert_array_equal(again.flower_ids, whole.flower_ids)
    np.testing.assert_array_equal(again.cluster_ids, whole.cluster_ids)
    np.testing.assert_allclose(again.flowers.positions, whole.flowers.positions, atol=1e-12)


def test_a_mark_of_another_session_or_of_nothing_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match="missing"):
        resume(out, "x")
    with Journal(out, "a") as journal:
        journal.mark(tracker())
    with pytest.raises(InputError, match="expected 'b'"):
        resume(out, "b")
    (journal_of(out) / "mark.bin").write_bytes(pickle.dumps(os.system))
    with pytest.raises(InputError, match="has no place in a mark"):
        resume(out, "a")
    (journal_of(out) / "mark.bin").write_bytes(b"\x80\x05garbage")
    with pytest.raises(InputError, match="cannot be read"):
        resume(out, "a")


def test_a_full_disk_is_said_and_what_was_marked_stays(tmp_path: Path) -> None:
    t, out = tracker(), tmp_path / "out"
    with Journal(out, "a") as journal:
        for f in frames(10):
            journal.write(t.step(f), t)
        journal.mark(t)
        journal._files["rows.bin"].close()
        journal._files["rows.bin"] = open("/dev/full", "ab", buffering=0)  # noqa: SIM115
        late = [t.step(f) for f in frames(30)[10:]]
        with pytest.raises(OutputError, match="No space left"):
            write_all(journal, late, t)
    _, n_frames = resume(out, "a")
    assert n_frames >= 10
    assert len(read_journal(journal_of(out)).frames) >= 10


def write_all(journal: Journal, updates: list[Update], t: OnlineTracker) -> None:
    for update in updates:
        journal.write(update, t)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_killed_program_goes_on(tmp_path: Path, number: signal.Signals) -> None:
    folder, out = tmp_path / "session", tmp_path / "out"
    world = made()
    write_session(folder, world.session, world.truth)
    command = [sys.executable, "-m", "cluster_slam.cli", "track", str(folder), "-o", str(out), "--quiet"]
    process = subprocess.Popen([*command, "--realtime"], stderr=subprocess.PIPE)
    mark = journal_of(out) / "mark.bin"
    begun = time.monotonic()
    while not (mark.exists() and (journal_of(out) / "frames.bin").stat().st_size > 64 * 20):
        assert time.monotonic() - begun < 60
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == (143 if number is signal.SIGTERM else -9)
    if number is signal.SIGTERM:
        assert b"--resume" in said
    assert not out.exists()
    assert run([*command[3:], "--resume"]) == 0
    rows = (out / "observations.csv").read_text().splitlines()[1:]
    whole = track(world.session)
    assert [int(r.split(",")[1]) for r in rows] == whole.flower_ids.tolist()
    assert not journal_of(out).exists()


# --- who listens


class Reader:
    """A sink that can be slow, or go."""

    def __init__(self, *, is_slow: bool = False, goes_after: int = 10**9) -> None:
        self.lines: list[str] = []
        self._is_slow, self._goes_after = is_slow, goes_after

    def write(self, text: str) -> None:
        if len(self.lines) >= self._goes_after:
            raise BrokenPipeError
        if self._is_slow:
            time.sleep(0.02)
        self.lines.append(text)

    def close(self) -> None:
        return


def test_lines_are_json_and_say_what_the_update_says() -> None:
    t, updates = steps(frames(20))
    said = json.loads(line(updates[-1]))
    assert said["format"] == 1
    assert said["flowers"] == updates[-1].flower_ids.tolist()
    assert {track["id"] for track in said["tracks"]} == set(t.tracks().ids.tolist())
    assert sum(track["seen"] for track in said["tracks"]) == sum(i >= 0 for i in said["flowers"])


def test_a_slow_reader_loses_lines_and_a_gone_one_stops_nothing() -> None:
    _, updates = steps(frames(5))
    slow, gone, good = Reader(is_slow=True), Reader(goes_after=3), Reader()
    streams = [Stream(slow, patient=False), Stream(gone, patient=False), Stream(good, patient=True)]
    begun = time.monotonic()
    for i in range(600):
        for stream in streams:
            stream.put(updates[i % 5])
    assert time.monotonic() - begun < 10
    told = [stream.close() for stream in streams]
    assert "too slow" in told[0][0]
    assert "has gone" in told[1][-1]
    assert len(good.lines) == 600


def test_a_port_sends_to_whoever_listens_and_else_listens_itself() -> None:
    _, updates = steps(frames(3))
    with socket.create_server(("127.0.0.1", 0)) as server:
        stream = open_stream(f"tcp://127.0.0.1:{server.getsockname()[1]}", patient=True)
        reader, _ = server.accept()
        with reader:
            stream.put(updates[-1])
            assert json.loads(reader.makefile().readline())["stamp"] == updates[-1].stamp
            stream.close()
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    stream = open_stream(f"tcp://127.0.0.1:{port}", patient=True)
    with socket.create_connection(("127.0.0.1", port)) as reader:
        for _ in range(20):
            stream.put(updates[-1])
            time.sleep(0.01)
        assert json.loads(reader.makefile().readline())["format"] == 1
        stream.close()
    with pytest.raises(ConfigError, match="expected -"):
        open_stream("tcp://example.org:80", patient=True)


class Source:
    """A live source that yields what it is given."""

    def __init__(self, given: list[Frame]) -> None:
        self.header, self._given = Replay(made().session).header, given

    def frames(self) -> Iterator[Frame]:
        return iter(self._given)

    def notices(self) -> list:
        return []


def test_a_live_source_becomes_a_result(tmp_path: Path) -> None:
    given = frames(40)
    result = track_source(Source([*given[:20], given[5], *given[20:]]), tmp_path / "out")
    assert result.session.n_frames == 40
    assert len(result.flower_ids) == sum(len(f) for f in given)
    assert any("late" in w for w in result.warnings)


def test_the_hand_eye_transform_is_known_as_well_as_is_said() -> None:
    """Flowers that become landmarks have been seen by the same few frames: what these erred in common counts once."""
    nees = []
    for seed in range(4):
        world = simulate_session(replace(PRESETS["moderate"], duration_s=8.0, fps=15.0, n_clusters=8), seed=seed)
        session = world.session
        t = OnlineTracker(session.noise, session.T_flange_camera)
        for frame in Replay(session).frames():
            t.step(frame)
        error = se3_log(inverse(t.X) @ world.hand_eye.true)
        nees.append(float(error @ np.linalg.solve(t.cov_X, error)) / 6.0)
    assert np.mean(nees) < 2.2  # 24 degrees of freedom, one in a thousand


def test_what_was_hardly_seen_at_rest_may_hang_elsewhere() -> None:
    """All flowers of a cluster together; after seconds of rest nothing of it is left."""
    t, _ = steps(frames(12))
    table = t.world.flowers
    rows = np.flatnonzero(table.confirmed)
    doubt = np.array([k.doubt for k in t.world.clusters])[table.slot[rows]]
    cov = t.joint_cov(rows).reshape(len(rows), 3, len(rows), 3)
    assert (doubt > 0.004).any()
    assert (np.einsum("faga->fga", cov)[np.arange(len(rows)), np.arange(len(rows))] >= doubt[:, None] ** 2).all()
    mates = np.argwhere(np.triu(table.slot[rows][:, None] == table.slot[rows], 1))
    assert len(mates)
    for f, g in mates.tolist():
        apart = cov[f, :, f] + cov[g, :, g] - cov[f, :, g] - cov[g, :, f]
        assert np.sqrt(np.trace(apart)) < 2.0 * np.sqrt(np.trace(table.cov[rows[f]] + table.cov[rows[g]]))
    late, _ = steps(frames())
    assert min(k.doubt for k in late.world.clusters) < 1e-4
