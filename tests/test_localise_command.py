"""``cluster-slam localise`` through a map on disk: its files, its exit codes."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cluster_slam import open_session
from cluster_slam.cli.app import run
from cluster_slam.geometry import inverse, pose_from_tum, se3_log
from cluster_slam.io.session import open_truth
from cluster_slam.io.tables import TUM_POSE, read_tum
from cluster_slam.simulate import simulate
from cluster_slam.simulate.config import MODERATE


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session, a map of its plant, and a map of another."""
    place = tmp_path_factory.mktemp("localise")
    config = replace(MODERATE, duration_s=1.0, fps=10.0)
    for seed, name in ((3, "session"), (4, "other")):
        simulate(config, place / name, seed=seed)
        assert run(["map", "create", str(place / f"{name}.map"), "-q"]) == 0
        rest = str(place / name / "truth" / "rest.csv")
        assert run(["map", "add", str(place / f"{name}.map"), "--landmarks", rest, "--plant", "row3", "-q"]) == 0
    return place


def test_files_are_those_of_the_format(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(["localise", str(folder / "session"), "--map", str(folder / "session.map"), "-o", str(out), "-q"]) == 0
    page = (out / "report.html").read_text("utf-8")
    assert "<svg" in page
    assert "share within 1 cm, 1 degree" in page
    assert 'src="http' not in page
    session = open_session(folder / "session")
    truth = open_truth(folder / "session", session)
    assert truth is not None
    assert truth.T_world_camera is not None
    with (out / "localisation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:6] == ["timestamp", "state", "reason", "plant", "n_inliers", "probability"]
    assert list(rows[0])[6:8] == ["cov_00", "cov_01"]
    assert list(rows[0])[-1] == "cov_55"
    assert len(list(rows[0])) == 6 + 21
    assert len(rows) == session.n_frames
    located = [r for r in rows if r["state"] == "located"]
    assert all(r["reason"] == "" and r["plant"] == "row3" for r in located)
    table = read_tum(out / "localisation.txt")
    assert len(table) == len(located) > 8
    frames = [i for i, r in enumerate(rows) if r["state"] == "located"]
    xi = se3_log(inverse(pose_from_tum(table.stack(TUM_POSE))) @ truth.T_world_camera[frames])
    assert np.linalg.norm(xi[:, 3:], axis=1).max() < 0.01
    upper = np.triu_indices(6)
    for r, error in zip(located, xi, strict=True):
        cov = np.zeros((6, 6))
        cov[upper] = [float(r[f"cov_{i}{j}"]) for i, j in zip(*upper, strict=True)]
        cov = cov + np.triu(cov, 1).T
        assert error @ np.linalg.solve(cov, error) < 60.0
    with (out / "localisation_observations.csv").open() as file:
        seen = list(csv.DictReader(file))
    assert len(seen) == len(session.observations)
    assert {r["flower_map_id"] == "-1" for r in seen} >= {False}
    assert all((r["flower_map_id"] == "-1") == (r["cluster_map_id"] == "-1") for r in seen)
    record = json.loads((out / "run.json").read_text())
    assert record["command"] == "localise"
    assert record["counts"]["located"] == len(located)
    assert (out / "hypotheses.csv").read_text().startswith("timestamp,rank,probability,tx,ty,tz,qx,qy,qz,qw\n")
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["located"] == len(located) / len(rows)
    shift = np.linalg.norm(xi[:, 3:], axis=1)
    assert metrics["is_aligned"] or metrics["ate_rmse_m"] == pytest.approx(np.sqrt((shift**2).mean()))
    assert metrics["flower_idf1"] > 0.95
    assert b"<svg" in (out / "localisation.svg").read_bytes()
    again = run(["localise", str(folder / "session"), "-m", str(folder / "session.map"), "-o", str(out), "-q"])
    assert again == 0  # in place of the earlier result, picture and all


def test_another_plants_map_gives_no_place_and_says_so(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = folder / "session"
    few = tmp_path / "few"
    few.mkdir()
    for name in ("session.toml", "flowers.csv"):
        (few / name).write_bytes((session / name).read_bytes())
    lines = (session / "poses.txt").read_text().splitlines()
    (few / "poses.txt").write_text("\n".join(lines[:2]) + "\n")
    stamp = lines[1].split()[0]
    table = (session / "flowers.csv").read_text().splitlines()
    (few / "flowers.csv").write_text("\n".join([table[0], *(r for r in table[1:] if r.startswith(stamp))]) + "\n")
    assert run(["localise", str(few), "--map", str(folder / "other.map"), "-o", str(tmp_path / "out"), "-q"]) == 1
    assert "no frame was located" in capsys.readouterr().err
    assert "lost,no_match" in (tmp_path / "out" / "localisation.csv").read_text()


def test_an_empty_or_missing_map_is_bad_input(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty.map"
    assert run(["map", "create", str(empty), "-q"]) == 0
    for path, words in ((empty, "no plant"), (tmp_path / "none.map", "missing")):
        code = run(["localise", str(folder / "session"), "--map", str(path), "-o", str(tmp_path / "out"), "-q"])
        assert code == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
