"""The main job as a user runs it, in processes of its own: simulate, smooth, evaluate; the same bytes each time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from result_format import check_result_folder

TIMED = ("run.json", "report.html")  # they say how long the run took


def cluster_slam(*arguments: str, hash_seed: str = "0") -> str:
    """Stdout of the command, which must succeed and say nothing on stderr."""
    done = subprocess.run(
        [sys.executable, "-m", "cluster_slam.cli", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONHASHSEED": hash_seed},
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session ``s`` of the preset ``sample`` and two results of it, ``a`` and ``b``."""
    root = tmp_path_factory.mktemp("job")
    cluster_slam("simulate", str(root / "s"), "--preset", "sample", "--seed", "1", "--quiet")
    for name, hash_seed in (("a", "1"), ("b", "2")):
        cluster_slam("smooth", str(root / "s"), "-o", str(root / name), "--quiet", hash_seed=hash_seed)
    return root


def test_the_result_keeps_the_format(folder: Path) -> None:
    check_result_folder(folder / "a", folder / "s")


def test_the_same_session_and_seed_give_the_same_bytes(folder: Path) -> None:
    names = sorted(path.name for path in (folder / "a").iterdir())
    assert names == sorted(path.name for path in (folder / "b").iterdir())
    for name in names:
        if name not in TIMED:
            assert (folder / "a" / name).read_bytes() == (folder / "b" / name).read_bytes(), name
    runs = [json.loads((folder / name / "run.json").read_text()) for name in "ab"]
    for run in runs:
        del run["timings_s"]
    assert runs[0] == runs[1]


def test_evaluate_reads_back_what_smooth_measured(folder: Path) -> None:
    found = json.loads(cluster_slam("evaluate", str(folder / "a"), str(folder / "s"), "--json"))
    written = json.loads((folder / "a" / "metrics.json").read_text())
    assert found == pytest.approx(written, rel=1e-4, abs=1e-8)
    assert found["cluster_idf1"] > 0.98
