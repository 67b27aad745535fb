"""Damaged files: whatever bytes are in them, a session is read or refused in one line, never anything else."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from folders import FLOWERS_COV, LEVEL_2, LEVEL_3, POSES, write_folder
from hypothesis import example, given, settings
from hypothesis import strategies as st
from made_result import make

from cluster_slam.errors import InputError
from cluster_slam.io.read_result import read_result
from cluster_slam.io.result import write_result
from cluster_slam.io.session import open_session, open_truth

TRUTH = {
    "truth/poses.txt": POSES,
    "truth/observations.csv": "flower_id,cluster_id\n4,1\n-1,-1\n5,1\n",
    "truth/rest.csv": "flower_id,cluster_id,x,y,z\n4,1,0.1,0.2,0.3\n5,1,0.4,0.5,0.6\n",
}
LEVELS = ({**LEVEL_3, **TRUTH, "flowers.csv": FLOWERS_COV}, {**LEVEL_2, **TRUTH})
PLACES = [(level, name) for level, files in enumerate(LEVELS) for name in files]
VALUES = ["nan", "-inf", "1e400", "", '"', "\n", "\r", ",", ";", "[", "]", "=", "#", "\0", "-", "1_0", "٣", "\ufeff"]
PATCHES = st.one_of(st.sampled_from([value.encode() for value in VALUES]), st.binary(max_size=6))


def check_line(error: InputError) -> None:
    message = str(error)
    assert "\n" not in message
    assert "expected" in message
    assert len(message) < 500


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(PLACES), st.integers(0, 400), st.integers(0, 12), PATCHES)
@example((0, "poses.txt"), 0, 400, b"")
def test_a_patched_session_is_read_or_refused(place: tuple[int, str], at: int, cut: int, patch: bytes) -> None:
    level, name = place
    data = LEVELS[level][name].encode()
    at %= len(data) + 1
    with tempfile.TemporaryDirectory() as folder:
        write_folder(Path(folder), {**LEVELS[level], name: data[:at] + patch + data[at + cut :]})
        try:
            session = open_session(folder)
            open_truth(folder, session)
        except InputError as error:
            check_line(error)
            return
    seen = session.observations
    assert np.isfinite(session.poses).all()
    assert np.isfinite(seen.points).all()
    assert (np.diff(session.stamps) > 0).all()
    np.linalg.cholesky(seen.covs)
    assert ((seen.frame >= 0) & (seen.frame < session.n_frames)).all()


@pytest.fixture(scope="module")
def result_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("result") / "out"
    write_result(make(3, n_frames=20).result, out)
    return out


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(
        ["trajectory.txt", "observations.csv", "clusters.csv", "flowers.csv", "calibration.toml", "run.json"]
    ),
    st.integers(0, 3000),
    st.integers(0, 12),
    PATCHES,
)
def test_a_patched_result_is_read_or_refused(result_folder: Path, name: str, at: int, cut: int, patch: bytes) -> None:
    files = {path.name: path.read_bytes() for path in result_folder.iterdir()}
    at %= len(files[name]) + 1
    with tempfile.TemporaryDirectory() as folder:
        write_folder(Path(folder), {**files, name: files[name][:at] + patch + files[name][at + cut :]})
        try:
            read_result(folder, make(3, n_frames=20).session)
        except InputError as error:
            check_line(error)


@pytest.mark.parametrize(
    ("key", "value"),
    [("timings_s", 3), ("counts", [1]), ("merged", [1, 2]), ("seed", "x"), ("warnings", 5), ("estimated_noise", "a")],
)
def test_a_run_record_of_other_types(result_folder: Path, key: str, value: object) -> None:
    with tempfile.TemporaryDirectory() as folder:
        files = {path.name: path.read_bytes() for path in result_folder.iterdir()}
        record = {**json.loads(files["run.json"]), key: value}
        write_folder(Path(folder), {**files, "run.json": json.dumps(record)})
        with pytest.raises(InputError, match=rf"run.json: .*{key}"):
            read_result(folder, make(3, n_frames=20).session)


def _changed(folder: Path, name: str, change: Callable[[list[str]], list[str]]) -> dict[str, bytes]:
    """The files of a result, the rows of one of which (without its header) have been changed."""
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    header, *rows = files[name].decode().splitlines()
    return {**files, name: ("\n".join([header, *change(rows)]) + "\n").encode()}


def _far(row: str) -> str:
    """A cluster's row with a coordinate that no plant has."""
    cells = row.split(",")
    return ",".join([cells[0], "1e300", *cells[2:]])


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("clusters.csv", lambda rows: rows[1:], r"flowers.csv: row \d+: cluster_id is \d+, expected one of those in"),
        ("clusters.csv", lambda rows: [*rows, rows[0]], r"clusters.csv: row \d+: cluster_id \d+ again, expected"),
        (
            "clusters.csv",
            lambda rows: [_far(rows[0]), *rows[1:]],
            r"clusters.csv: row 2: x is 1e\+300, expected metres",
        ),
        ("flowers.csv", lambda rows: [rows[0], *rows], r"flowers.csv: row 3: flower_id \d+ again, expected"),
    ],
)
def test_tables_that_contradict_each_other(
    result_folder: Path, tmp_path: Path, name: str, change: Callable[[list[str]], list[str]], says: str
) -> None:
    write_folder(tmp_path, _changed(result_folder, name, change))
    with pytest.raises(InputError, match=says):
        read_result(tmp_path, make(3, n_frames=20).session)


@pytest.mark.parametrize("name", ["clusters.csv", "flowers.csv"])
def test_landmarks_stand_in_any_order(result_folder: Path, tmp_path: Path, name: str) -> None:
    session = make(3, n_frames=20).session
    write_folder(tmp_path, _changed(result_folder, name, lambda rows: rows[::-1]))
    turned, straight = read_result(tmp_path, session), read_result(result_folder, session)
    for a, b in ((turned.clusters, straight.clusters), (turned.flowers, straight.flowers)):
        np.testing.assert_array_equal(a.ids, b.ids)
        np.testing.assert_array_equal(a.positions, b.positions)
    assert turned.clusters.states == straight.clusters.states
