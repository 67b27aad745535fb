"""``cluster-slam experiment``: sweeps over worlds and options, one tidy table, the plots of a paper."""

from __future__ import annotations

import json
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings

if TYPE_CHECKING:
    from cluster_slam.experiment.table import Summary


def command(
    experiment: Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="What to run.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Folder; a run that was killed in it goes on.")
    ],
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Processes on this machine.")] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="tcp://HOST:PORT", help="A Dask scheduler instead.", show_default=False),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Run a method over a sweep of simulated worlds and options, with several seeds each.

    OUT gets table.csv (a row for each cell and seed), summary.csv (means with 95 % intervals) and a plot of each
    figure. What is finished is kept: a killed run goes on where it was.

    Example: cluster-slam experiment sweep.toml -o out/sweep --jobs 4
    """
    from cluster_slam.experiment import read_experiment, run_experiment
    from cluster_slam.experiment.plots import plots
    from cluster_slam.experiment.run import JOURNAL, check_experiment_output
    from cluster_slam.experiment.table import summaries, summary_csv, table_csv
    from cluster_slam.io.folder import write_folder

    plan = read_experiment(experiment)
    check_experiment_output(out)
    begin = perf_counter()
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        rows = run_experiment(plan, out, jobs=jobs, scheduler=scheduler, progress=progress)
        found = summaries(rows)
        files: dict[str, str | bytes] = {
            "experiment.toml": experiment.read_text("utf-8"),
            "table.csv": table_csv(plan, rows),
            "summary.csv": summary_csv(plan, found),
            **plots(plan, found),
        }
        write_folder(out, {JOURNAL: (out / JOURNAL).read_bytes(), **files})
    failed = sum(int(figures.get("failed", 0.0)) for _, figures in rows)
    if as_json:
        print_json({"out": str(out), "cells": len(rows), "failed": failed, "files": sorted(files)})
    elif not quiet:
        _tell(plan.name, found, len(rows), perf_counter() - begin, out)
    if failed:
        print_warnings([f"{failed} of {len(rows)} cells could not be run: no such world, or it gave no estimate"])
    return 1 if failed == len(rows) else 0


def _tell(name: str, found: list[Summary], n: int, seconds: float, out: Path) -> None:
    points = list(dict.fromkeys(s.point for s in found))
    shown = []
    for point in points:
        here = [s for s in found if s.point == point and s.n and s.figure != "seconds"][:6]
        where = ", ".join(f"{k} = {json.dumps(v)}" for k, v in point) or "all"
        shown.append((where, ", ".join(f"{s.figure} {s.mean:.4g}" for s in here)))
    rows = [("cells", str(n)), ("time", f"{seconds:.1f} s"), *shown, ("tables and plots", str(out))]
    print_table(f"cluster-slam experiment: {name}", rows)
