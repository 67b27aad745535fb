"""Experiments of all four kinds, and one that is killed for real."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cluster_slam.experiment import read_experiment, run_experiment
from cluster_slam.experiment.run import JOURNAL
from cluster_slam.experiment.table import summaries

pytestmark = pytest.mark.nightly
FIGURES = {"localise": "located", "smooth": "cluster_idf1", "track": "cluster_idf1", "reidentify": "cluster_f1"}
TEXT = """name = "{task}"
task = "{task}"
preset = "moderate"
seeds = 2
[fixed]
duration_s = 3.0
fps = 10.0
[sweep]
n_clusters = [6, 8]
"""


@pytest.mark.parametrize("task", FIGURES)
def test_all_kinds_give_their_figures(task: str, tmp_path: Path) -> None:
    path = tmp_path / "experiment.toml"
    path.write_text(TEXT.format(task=task))
    rows = run_experiment(read_experiment(path), tmp_path / "out")
    assert len(rows) == 4
    assert not any(figures.get("failed") for _, figures in rows)
    means = [s.mean for s in summaries(rows) if s.figure == FIGURES[task]]
    assert len(means) == 2
    assert min(means) > 0.8


def test_a_killed_run_goes_on(tmp_path: Path) -> None:
    """SIGKILL after the first cell: what was done is not done again, and the table is that of a run in one piece."""
    path, out = tmp_path / "experiment.toml", tmp_path / "out"
    path.write_text(TEXT.format(task="localise"))
    command = [sys.executable, "-m", "cluster_slam.cli", "experiment", str(path), "-o", str(out), "-q"]
    running = subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline and running.poll() is None:
        if (out / JOURNAL).exists() and len((out / JOURNAL).read_text().split("\n")) > 2:
            break
        time.sleep(0.05)
    running.send_signal(signal.SIGKILL)
    running.wait(timeout=20)
    before = (out / JOURNAL).read_text().split("\n")
    assert 2 < len(before) < 6
    assert subprocess.run(command, timeout=600).returncode == 0
    after = (out / JOURNAL).read_text().split("\n")
    assert after[: len(before) - 1] == before[:-1]
    assert len((out / "table.csv").read_text().strip().split("\n")) == 5
