"""What the format page promises about a result folder, held against the session it was made from."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from cluster_slam.io.session import open_session

POINT_COV = ["cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"]
COLUMNS = {
    "observations.csv": ["timestamp", "flower_id", "cluster_id"],
    "clusters.csv": [
        *["cluster_id", "x", "y", "z", *POINT_COV, "n_flowers", "inertia", "mean_distance", "cov_ii", "cov_id"],
        *["cov_dd", "first_seen", "last_seen", "n_observations", "state"],
    ],
    "flowers.csv": ["flower_id", "cluster_id", "x", "y", "z", *POINT_COV, "first_seen", "last_seen", "n_observations"],
    "drift.csv": ["timestamp", "cluster_id", "x", "y", "z", *POINT_COV],
}
RUN_KEYS = {"version", "command", "config", "seed", "timings_s", "counts", "warnings", "merged", "status"}
Rows = list[dict[str, str]]


def read_rows(path: Path) -> Rows:
    """A table as the standard library reads it."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def check_result_folder(out: Path, session_folder: Path) -> None:
    """Assert all that the format says about a result of ``smooth``."""
    session = open_session(session_folder)
    tables = {name: read_rows(out / name) for name in COLUMNS}
    for name, columns in COLUMNS.items():
        assert (out / name).read_text().split("\n", 1)[0].split(",")[: len(columns)] == columns
    _check_trajectory(out / "trajectory.txt", session.stamps)
    _check_observations(tables["observations.csv"], session.stamps[session.observations.frame])
    for name in ("clusters.csv", "flowers.csv", "drift.csv"):
        _check_covariances(tables[name])
    _check_members(tables["clusters.csv"], tables["flowers.csv"], tables["observations.csv"])
    run = json.loads((out / "run.json").read_text())
    assert run.keys() >= RUN_KEYS
    assert run["status"] in ("ok", "poor")
    assert (out / "report.html").read_text().lstrip().lower().startswith("<!doctype html>")


def _check_trajectory(path: Path, stamps: np.ndarray) -> None:
    rows = np.loadtxt(path, ndmin=2)
    np.testing.assert_allclose(rows[:, 0], stamps, rtol=0, atol=1e-6)
    assert np.isfinite(rows).all()
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1, atol=1e-6)


def _check_observations(rows: Rows, stamps: np.ndarray) -> None:
    np.testing.assert_allclose([float(row["timestamp"]) for row in rows], stamps, rtol=0, atol=1e-6)
    assert all((row["flower_id"] == "-1") == (row["cluster_id"] == "-1") for row in rows)


def _check_covariances(rows: Rows) -> None:
    upper = np.array([[float(row[name]) for name in POINT_COV] for row in rows]).reshape(-1, 6)
    assert np.isfinite(upper).all()
    assert (np.linalg.eigvalsh(upper[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]) > 0).all()


def _check_members(clusters: Rows, flowers: Rows, observations: Rows) -> None:
    of_flower = {row["flower_id"]: row["cluster_id"] for row in flowers}
    assert len(of_flower) == len(flowers)
    assert sorted(set(of_flower.values())) == sorted(row["cluster_id"] for row in clusters)
    for row in observations:
        assert row["flower_id"] == "-1" or of_flower[row["flower_id"]] == row["cluster_id"]
    for cluster in clusters:
        assert cluster["state"] in ("tentative", "confirmed", "lost")
        members = [[float(row[k]) for k in "xyz"] for row in flowers if row["cluster_id"] == cluster["cluster_id"]]
        assert len(members) == int(cluster["n_flowers"])
        np.testing.assert_allclose(np.mean(members, axis=0), [float(cluster[k]) for k in "xyz"], rtol=0, atol=1e-8)
