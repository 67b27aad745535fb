"""Sweeps: what is run, what is kept, what comes out."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cluster_slam.cli.app import run
from cluster_slam.errors import ConfigError, InputError, OutputError
from cluster_slam.experiment import read_experiment, run_experiment
from cluster_slam.experiment.plan import Cell
from cluster_slam.experiment.run import JOURNAL
from cluster_slam.experiment.table import mean_interval, summaries, table_csv

SMALL = """name = "small"
task = "localise"
preset = "moderate"
seeds = 2
[fixed]
duration_s = 0.2
fps = 5.0
independent = true
[sweep]
n_clusters = [12, 14]
"config.sway_m" = [0.001, 0.002]
"""


def experiment_file(folder: Path, text: str = SMALL) -> Path:
    path = folder / "experiment.toml"
    path.write_text(text)
    return path


def test_cells_are_the_product_in_order(tmp_path: Path) -> None:
    plan = read_experiment(experiment_file(tmp_path))
    assert len(plan.cells) == 2 * 2 * 2
    assert [c.seed for c in plan.cells[:2]] == [0, 1]
    assert [dict(c.swept)["n_clusters"] for c in plan.cells] == [12] * 4 + [14] * 4
    assert len({c.key for c in plan.cells}) == 8


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (("n_clusters = [12, 14]", "n_cluster = [5]"), ConfigError, "did you mean n_clusters"),
        (('"config.sway_m"', '"config.swy_m"'), ConfigError, "sway_m"),
        (('task = "localise"', 'task = "fly"'), InputError, "expected one of"),
        (("seeds = 2", "seeds = [1, 1]"), InputError, "different ones"),
        (("n_clusters = [12, 14]", "n_clusters = 5"), InputError, "list of values"),
        (("[sweep]", "[swep]"), InputError, "did you mean sweep"),
        (('preset = "moderate"', 'preset = "moderat"'), InputError, "did you mean moderate"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, change: tuple[str, str], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        read_experiment(experiment_file(tmp_path, SMALL.replace(*change)))


def test_a_run_that_was_cut_off_goes_on(tmp_path: Path) -> None:
    plan = read_experiment(experiment_file(tmp_path))
    whole = run_experiment(plan, tmp_path / "whole")
    lines = (tmp_path / "whole" / JOURNAL).read_text().split("\n")
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / JOURNAL).write_text("\n".join([*lines[:4], lines[4][:20]]))
    again = run_experiment(plan, tmp_path / "cut")
    assert (tmp_path / "cut" / JOURNAL).read_text().split("\n")[:4] == lines[:4]
    timed = {"seconds", "ms_per_frame"}
    for (cell, a), (other, b) in zip(whole, again, strict=True):
        assert cell == other
        assert {k: v for k, v in a.items() if k not in timed} == {k: v for k, v in b.items() if k not in timed}


def test_another_experiment_is_not_mixed_in(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / JOURNAL).write_text('{"experiment": "other", "digest": "x"}\n')
    with pytest.raises(OutputError, match="another experiment"):
        run_experiment(read_experiment(experiment_file(tmp_path)), tmp_path / "out")


def test_intervals_are_students() -> None:
    """Of 1, 2, 3: mean 2, standard error 1 / sqrt 3, t(2, 97.5 %) = 4.303."""
    mean, low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
    assert mean == 2.0
    assert high - mean == pytest.approx(4.302653 / np.sqrt(3.0), rel=1e-6)
    assert mean - low == pytest.approx(high - mean)


def test_intervals_stay_where_figures_can_be() -> None:
    cells = [Cell("localise", "moderate", (), (), seed) for seed in (0, 1)]
    rows = [(cell, {"located": x, "nees_over_6": 3.0 * x}) for cell, x in zip(cells, (0.4, 0.9), strict=True)]
    shares, nees = summaries(rows)
    assert (shares.low, shares.high) == (0.0, 1.0)
    assert nees.low == 0.0
    assert nees.high > 5.0


def test_the_command_writes_tables_and_plots(tmp_path: Path) -> None:
    out = tmp_path / "out"
    text = SMALL.replace("seeds = 2", "seeds = [4]").replace('"config.sway_m" = [0.001, 0.002]\n', "")
    assert run(["experiment", str(experiment_file(tmp_path, text)), "-o", str(out), "-q"]) == 0
    with (out / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["n_clusters"], r["seed"]) for r in rows] == [("12", "4"), ("14", "4")]
    assert all(0.0 <= float(r["located"]) <= 1.0 for r in rows)
    assert (out / "located.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (out / "located.svg").read_bytes()
    assert "located" in (out / "summary.csv").read_text()
    plan = read_experiment(tmp_path / "experiment.toml")
    found = run_experiment(plan, out)  # all is there already
    assert table_csv(plan, found) == (out / "table.csv").read_text()
    assert {s.n for s in summaries(found) if s.figure == "located"} == {1}


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious.txt").write_text("x")
    assert run(["experiment", str(experiment_file(tmp_path)), "-o", str(tmp_path / "out"), "-q"]) == 2
    assert "precious.txt" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["precious.txt"]


def test_a_real_scheduler_with_two_workers(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs the extra cluster")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "DASK_DISTRIBUTED__WORKER__DAEMON": "false"}
    file = tmp_path / "scheduler.json"
    base = [sys.executable, "-W", "ignore", "-m"]
    begin = ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"]
    started = [
        subprocess.Popen([*base, *begin, "--scheduler-file", str(file)], env=environment, stderr=subprocess.DEVNULL)
    ]
    try:
        deadline = time.monotonic() + 60.0
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        for _ in range(2):
            worker = [
                "distributed.cli.dask_worker",
                "--scheduler-file",
                str(file),
                "--nthreads",
                "1",
                "--no-dashboard",
                "--no-nanny",
            ]
            started.append(subprocess.Popen([*base, *worker], env=environment, stderr=subprocess.DEVNULL, cwd=tmp_path))
        import json

        address = json.loads(file.read_text())["address"]
        text = SMALL.replace('"config.sway_m" = [0.001, 0.002]\n', "")
        plan_file = experiment_file(tmp_path, text)
        code = [
            *base,
            "cluster_slam.cli",
            "experiment",
            str(plan_file),
            "-o",
            str(tmp_path / "far"),
            "--scheduler",
            address,
            "-q",
        ]
        assert subprocess.run(code, env=environment, timeout=180).returncode == 0
        plan = read_experiment(plan_file)
        far, near = run_experiment(plan, tmp_path / "far"), run_experiment(plan, tmp_path / "near")
        for (cell, a), (other, b) in zip(far, near, strict=True):
            assert cell == other
            assert a["located"] == b["located"]
    finally:
        for process in reversed(started):
            process.kill()
            process.wait(timeout=20)
