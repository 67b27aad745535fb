"""Results out: held against the format, written whole or not at all, read back as they were, and fast."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_result import make
from result_format import check_result_folder, read_rows

from cluster_slam.errors import EstimationError, InputError, OutputError
from cluster_slam.geometry import tum_from_pose
from cluster_slam.io import folder as io_folder
from cluster_slam.io.read_result import read_result
from cluster_slam.io.result import check_output, stamp_words, write_result
from cluster_slam.io.session_writer import write_session
from cluster_slam.records import Drift, Result

MADE = make(3, n_frames=60)


def written(tmp_path: Path, result: Result = MADE.result, **extra: str) -> Path:
    write_result(result, tmp_path / "out", extra_files={name.replace("__", "."): text for name, text in extra.items()})
    return tmp_path / "out"


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_a_result_keeps_the_format(tmp_path: Path) -> None:
    write_session(tmp_path / "session", MADE.session)
    check_result_folder(written(tmp_path, report__html="<!doctype html>"), tmp_path / "session")


def test_trajectory_is_a_tum_file_row_for_row(tmp_path: Path) -> None:
    table = np.loadtxt(written(tmp_path) / "trajectory.txt")
    np.testing.assert_array_equal(table[:, 0], MADE.session.stamps)
    np.testing.assert_allclose(table[:, 1:], tum_from_pose(MADE.result.T_world_camera), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(table[:, 4:], axis=1), 1, atol=1e-11)


def test_observations_are_row_for_row(tmp_path: Path) -> None:
    table = read_rows(written(tmp_path) / "observations.csv")
    assert [int(row["flower_id"]) for row in table] == MADE.result.flower_ids.tolist()
    assert [int(row["cluster_id"]) for row in table] == MADE.result.cluster_ids.tolist()
    assert [float(row["timestamp"]) for row in table] == MADE.session.stamps[MADE.session.observations.frame].tolist()
    assert all((row["flower_id"] == "-1") == (row["cluster_id"] == "-1") for row in table)


def test_calibration(tmp_path: Path) -> None:
    content = tomllib.loads((written(tmp_path) / "calibration.toml").read_text())
    assert MADE.result.calibration is not None
    np.testing.assert_allclose(
        content["T_flange_camera"], tum_from_pose(MADE.result.calibration.T_flange_camera), rtol=1e-11, atol=1e-14
    )
    np.testing.assert_allclose(content["covariance"], MADE.result.calibration.cov, rtol=1e-11)
    plain = written(tmp_path / "b", replace(MADE.result, calibration=None))
    assert not (plain / "calibration.toml").exists()


def test_run_record(tmp_path: Path) -> None:
    result = replace(MADE.result, merged=((3, 1),), warnings=("odd",), config={"gate_probability": 0.99}, status="poor")
    run = json.loads((written(tmp_path, result, report__html="<html>") / "run.json").read_text())
    assert run.keys() >= {"version", "command", "config", "seed", "timings_s", "counts", "warnings", "merged", "status"}
    assert (run["command"], run["status"], run["merged"], run["warnings"]) == ("smooth", "poor", [[3, 1]], ["odd"])
    assert run["config"] == {"gate_probability": 0.99}
    assert "report.html" in run["files"]


def test_what_is_read_back_is_what_was_written(tmp_path: Path) -> None:
    result = replace(MADE.result, merged=((3, 1),), warnings=("odd",), seed=5)
    back = read_result(written(tmp_path, result), MADE.session)
    for part in ("flowers", "clusters", "drift", "diagnostics", "calibration"):
        made, found = getattr(result, part), getattr(back, part)
        for name in type(made).__slots__:
            a, b = getattr(made, name), getattr(found, name)
            if isinstance(a, np.ndarray):
                np.testing.assert_allclose(b, a, rtol=1e-4 if name == "nis" else 1e-11, atol=1e-9 * (name != "covs"))
            else:
                assert a == b
    np.testing.assert_allclose(back.T_world_camera, result.T_world_camera, atol=1e-9)
    np.testing.assert_array_equal(back.flower_ids, result.flower_ids)
    assert (back.merged, back.warnings, back.seed, back.status) == (((3, 1),), ("odd",), 5, "ok")


def test_descriptors_that_are_not_known(tmp_path: Path) -> None:
    clusters = replace(MADE.result.clusters, descriptors=np.full((len(MADE.result.clusters), 2), np.nan))
    back = read_result(written(tmp_path, replace(MADE.result, clusters=clusters)), MADE.session)
    assert np.isnan(back.clusters.descriptors).all()


def test_nothing_found(tmp_path: Path) -> None:
    r = MADE.result
    nothing = replace(
        r,
        flower_ids=np.full_like(r.flower_ids, -1),
        cluster_ids=np.full_like(r.cluster_ids, -1),
        flowers=_emptied(r.flowers),
        clusters=replace(_emptied(r.clusters), states=()),
        drift=_emptied(r.drift),
    )
    back = read_result(written(tmp_path, nothing), MADE.session)
    assert (len(back.flowers), len(back.clusters), len(back.drift.frame)) == (0, 0, 0)
    assert back.flowers.covs.shape == (0, 3, 3)


def _emptied(record):  # type: ignore[no-untyped-def]
    arrays = {name: getattr(record, name) for name in type(record).__slots__}
    return replace(record, **{name: a[:0] for name, a in arrays.items() if isinstance(a, np.ndarray)})


def test_stamps_read_back_as_they_were() -> None:
    stamps = np.array([0.0, 0.1, 1248444189.599, 1.7e9 + 1 / 3, 1e-9, 86400.0])
    words = stamp_words(stamps)
    assert [float(word) for word in words] == stamps.tolist()
    assert words[:3] == ["0.000000", "0.100000", "1248444189.599000"]


def test_the_same_result_is_the_same_bytes(tmp_path: Path) -> None:
    assert snapshot(written(tmp_path / "a")) == snapshot(written(tmp_path / "b"))


def test_a_result_of_another_session_is_refused(tmp_path: Path) -> None:
    out = written(tmp_path)
    other = make(4, n_frames=60).session
    with pytest.raises(InputError, match=r"observations.csv: \d+ rows, expected \d+"):
        read_result(out, other)
    later = replace(MADE.session, stamps=MADE.session.stamps + 1.0)
    with pytest.raises(InputError, match=r"trajectory.txt: row 2: timestamp .*, expected .* as in the session"):
        read_result(out, later)
    with pytest.raises(InputError, match="missing, expected a result folder"):
        read_result(tmp_path / "nothing", MADE.session)


def test_what_is_not_finite_is_not_written(tmp_path: Path) -> None:
    T = MADE.result.T_world_camera.copy()
    T[7, 0, 3] = np.nan
    with pytest.raises(EstimationError, match="camera pose 7 is not finite"):
        write_result(replace(MADE.result, T_world_camera=T), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- where results may go


def test_absent_empty_and_earlier_results_are_fine(tmp_path: Path) -> None:
    check_output(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    written(tmp_path, report__html="one", more__txt="x")
    written(tmp_path, report__html="two")
    assert (tmp_path / "out" / "report.html").read_text() == "two"
    assert not (tmp_path / "out" / "more.txt").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_folders_of_others_are_refused_and_left_alone(tmp_path: Path) -> None:
    for name, files, says in (
        ("a", {"notes.txt": "mine"}, "holds notes.txt but no run.json"),
        ("b", {"run.json": "{}", "notes.txt": "mine"}, "is no result's"),
        ("c", {"run.json": "not JSON"}, "cannot be read as a result's"),
        ("d", {".git": "hidden"}, "holds .git but no run.json"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        for file, text in files.items():
            (folder / file).write_text(text)
        before = snapshot(folder)
        with pytest.raises(OutputError, match=says):
            write_result(MADE.result, folder)
        assert snapshot(folder) == before


def test_a_note_beside_an_earlier_result_is_not_deleted(tmp_path: Path) -> None:
    out = written(tmp_path)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"holds notes.txt, which is no part of a result"):
        write_result(MADE.result, out)
    assert (out / "notes.txt").read_text() == "mine"


def test_files_and_dangling_links_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="is a file, expected a folder"):
        check_output(tmp_path / "file")
    with pytest.raises(OutputError, match=r"cannot be written in .*Not a directory"):
        check_output(tmp_path / "file" / "out")
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    with pytest.raises(OutputError, match="link to nothing"):
        check_output(tmp_path / "link")
    with pytest.raises(OutputError, match=r"mounted|cannot be written"):
        check_output(Path("/proc"))
    with pytest.raises(OutputError, match="cannot be written in /proc"):
        check_output(Path("/proc/out"))


def test_a_link_to_a_folder_stays_one(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "real")
    written(tmp_path)
    written(tmp_path)
    assert (tmp_path / "out").is_symlink()
    assert (tmp_path / "real" / "run.json").exists()


def test_a_relative_name_and_permissions_as_usual(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_result(MADE.result, Path("out"))
    (tmp_path / "plain").mkdir()
    assert (tmp_path / "out").stat().st_mode == (tmp_path / "plain").stat().st_mode


# --- whole or not at all


def fail_at_rename(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(io_folder, "_replace", fails)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_what_was_there_survives_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    before = snapshot(written(tmp_path))
    fail_at_rename(monkeypatch, error)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        write_result(replace(MADE.result, seed=9), tmp_path / "out")
    assert snapshot(tmp_path / "out") == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_without_exchange_two_renames_do_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(io_folder, "_exchange", lambda *_: False)
    written(tmp_path)
    written(tmp_path, replace(MADE.result, seed=9))
    assert json.loads((tmp_path / "out" / "run.json").read_text())["seed"] == 9
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_a_killed_run_moved_aside_is_put_back(tmp_path: Path) -> None:
    """A run killed between the two renames leaves the former result under a hidden name; 4194305 is no process."""
    before = snapshot(written(tmp_path))
    (tmp_path / "out").rename(tmp_path / ".out.4194305.abcd.old")
    (tmp_path / ".out.4194305.abcd.new").mkdir()
    check_output(tmp_path / "out")
    assert snapshot(tmp_path / "out") == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_a_living_process_writes_is_left_alone(tmp_path: Path) -> None:
    living = tmp_path / f".out.{os.getppid()}.abcd.new"
    living.mkdir()
    check_output(tmp_path / "out")
    assert living.exists()


KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from made_result import make
from result_format import check_result_folder, read_rows
from cluster_slam.io import folder
from cluster_slam.io.result import write_result
left = {after}
write = folder._write
def dying(path, content):
    global left
    left -= 1
    if left < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    write(path, content)
folder._write = dying
write_result(make(3, n_frames=60).result, Path({out!r}))
"""


@pytest.mark.parametrize("earlier", [True, False])
def test_a_killed_program_leaves_the_previous_result_or_none(tmp_path: Path, earlier: bool) -> None:
    out = tmp_path / "out"
    before = snapshot(written(tmp_path)) if earlier else None
    code = KILLED.format(tests=str(Path(__file__).parent), after=3, out=str(out))
    done = subprocess.run([sys.executable, "-c", code], check=False)
    assert done.returncode == -signal.SIGKILL
    assert (snapshot(out) if out.exists() else None) == before
    written(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_speed(tmp_path: Path) -> None:
    """108,000 observations and 72,000 rows of drift: measured 1.1 s to write and 0.9 s to read on a busy core."""
    m, d = 108_000, 72_000
    session = MADE.session
    frame = np.sort(np.random.default_rng(0).integers(0, session.n_frames, m))
    seen = replace(
        session.observations, frame=frame, points=np.ones((m, 3)), covs=np.tile(np.eye(3), (m, 1, 1)), scores=np.ones(m)
    )
    big = replace(session, observations=seen)
    diagnostics = replace(MADE.result.diagnostics, nis=np.full(m, 2.5), reasons=np.zeros(m, dtype=np.int64))
    drift = Drift(frame[:d], np.full(d, 10), np.full((d, 3), 0.123456789), np.tile(1e-6 * np.eye(3), (d, 1, 1)))
    ids = np.full(m, 100)
    result = replace(MADE.result, session=big, flower_ids=ids, cluster_ids=ids, drift=drift, diagnostics=diagnostics)
    begin = time.process_time()
    out = written(tmp_path, result)
    wrote = time.process_time()
    read_result(out, big)
    assert wrote - begin < 4.0
    assert time.process_time() - wrote < 4.0
