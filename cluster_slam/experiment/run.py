"""Cells farmed out over processes or machines; each finished one is on disk before the next is waited for."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from cluster_slam.errors import InputError, OutputError
from cluster_slam.experiment.plan import Cell, Experiment
from cluster_slam.experiment.tasks import Figures, run_cell

JOURNAL = "journal.jsonl"  # a line for each finished cell, beside OUT's tables until all are done
Progress = Callable[[str, float], None]


def run_experiment(
    experiment: Experiment, out: Path, *, jobs: int = 1, scheduler: str | None = None, progress: Progress | None = None
) -> list[tuple[Cell, Figures]]:
    """Run all cells that ``out`` does not hold yet, and return all, in the order of the table.

    Parameters
    ----------
    out : a folder; its journal holds what is done. A run that was killed goes on where it was.
    jobs : processes on this machine.
    scheduler : address of a Dask scheduler (``tcp://...``) whose workers do the work instead.

    Raises
    ------
    OutputError
        ``out`` holds something else, or another experiment.
    InputError
        The scheduler cannot be reached.
    """
    say = progress or (lambda _stage, _fraction: None)
    done = _begin(experiment, out)
    left = [cell for cell in experiment.cells if cell.key not in done]
    n = len(experiment.cells)
    with (out / JOURNAL).open("a", encoding="utf-8") as journal:
        for cell, figures in _worked(left, jobs, scheduler):
            done[cell.key] = figures
            journal.write(json.dumps({"key": cell.key, "figures": figures}) + "\n")
            journal.flush()
            os.fsync(journal.fileno())
            say(f"{len(done)} of {n} cells", len(done) / n)
    return [(cell, done[cell.key]) for cell in experiment.cells]


def check_experiment_output(out: Path) -> None:
    """Refuse a place that holds anything but an earlier run of an experiment.

    Raises
    ------
    OutputError
        Names the folder and what stands in the way.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file, expected a folder or a free name")
    names = sorted(entry.name for entry in out.iterdir()) if out.exists() else []
    if names and JOURNAL not in names:
        raise OutputError(f"{out}: holds {names[0]} but no {JOURNAL}, expected a free name or an earlier experiment")


def _begin(experiment: Experiment, out: Path) -> dict[str, Figures]:
    """What is done already; the journal is begun where there is none."""
    check_experiment_output(out)
    path = out / JOURNAL
    if path.exists():
        return _read(experiment, path)
    try:
        out.mkdir(parents=True, exist_ok=True)
        head = {"experiment": experiment.name, "digest": experiment.digest}
        path.write_text(json.dumps(head) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None
    return {}


def _read(experiment: Experiment, path: Path) -> dict[str, Figures]:
    lines = path.read_text("utf-8").split("\n")
    try:
        head = json.loads(lines[0])
        digest = head["digest"]
    except (json.JSONDecodeError, KeyError, TypeError):
        raise OutputError(f"{path}: row 1 names no experiment, expected the journal of an earlier run") from None
    if digest != experiment.digest:
        name = head.get("experiment")
        raise OutputError(f"{path}: holds another experiment ({name!r}), expected a folder of its own")
    done: dict[str, Figures] = {}
    whole = [lines[0]]
    for line in lines[1:]:
        try:
            row = json.loads(line)
            done[row["key"]] = row["figures"]
        except (json.JSONDecodeError, KeyError, TypeError):
            continue  # the line that a kill cut off
        whole.append(line)
    path.write_text("\n".join([*whole, ""]), encoding="utf-8")
    return done


def _worked(cells: list[Cell], jobs: int, scheduler: str | None) -> Iterator[tuple[Cell, Figures]]:
    if scheduler is not None:
        yield from _on_cluster(cells, scheduler)
    elif jobs == 1:
        for cell in cells:
            yield cell, run_cell(cell)
    else:
        from multiprocessing import get_context

        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            futures = {pool.submit(run_cell, cell): cell for cell in cells}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


def _on_cluster(cells: list[Cell], address: str) -> Iterator[tuple[Cell, Figures]]:
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError:
        raise InputError("--scheduler needs Dask: pip install 'cluster-slam[cluster]'") from None
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"no scheduler at {address!r} ({error}), expected tcp://HOST:PORT") from None
    with client, client.as_current():
        futures = client.map(run_cell, cells, pure=False)
        by_key = {future.key: cell for future, cell in zip(futures, cells, strict=True)}
        for future in completed(futures):
            yield by_key[future.key], future.result()
