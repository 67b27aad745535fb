"""`compare-descriptors`: one table, one figure, one page."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from cluster_slam.compare.comparison_page import Comparison, render
from cluster_slam.compare.contenders import contenders
from cluster_slam.compare.coverage import CoverageRow, coverage_table
from cluster_slam.compare.figure import draw
from cluster_slam.compare.population import Case
from cluster_slam.compare.recordings import PlantRow, RealRow, load_plants, plant_rows, real_rows
from cluster_slam.compare.trial import Outcome, Size, run_case
from cluster_slam.io.folder import write_folder
from cluster_slam.reproduce import drawing, page
from cluster_slam.reproduce.paper import check_replaceable

MARKER = "comparison.json"  # a folder that holds it may be replaced
Progress = Callable[[str, float], None]
NEAR, FAR = (0.03, 0.04), (0.07, 0.08)
CASES = (
    *(Case(0.002, n) for n in (3, 4, 5, 6)),
    *(Case(0.005, n) for n in (3, 4, 5, 6)),
    *(Case(0.010, n) for n in (3, 4, 5, 6)),
    *(Case(sigma, n, n_missing=1) for sigma in (0.002, 0.005) for n in (4, 5, 6)),
    *(Case(sigma, 5, n_new=1) for sigma in (0.002, 0.005)),
    *(Case(sigma, 5, n_missing=1, n_new=1) for sigma in (0.002, 0.005)),
    *(Case(0.005, 5, radius_m=radius) for radius in (NEAR, FAR)),
)


def compare_descriptors(
    out: Path,
    *,
    seed: int = 0,
    recordings: Path | None = None,
    progress: Progress | None = None,
    cases: Sequence[Case] = CASES,
    size: Size | None = None,
) -> Comparison:
    """All descriptors over noise, count, radius, missing and new flowers, and on real plants, into a folder.

    Files: `descriptors.csv`, `coverage.csv`, with recordings `real.csv` and `plants.csv`, the figure as PNG and SVG,
    and `index.html`.

    Parameters
    ----------
    out
        Absent, empty, or an earlier comparison, which is replaced whole.
    seed
        Of everything random.
    recordings
        Folder of the sessions `strawberryN-labels` and `strawberryN-strict`; None or absent: simulation alone.
    progress
        Called with a stage in words and the fraction done.
    cases, size
        What is asked, and on how many pairs.

    Raises
    ------
    OutputError
        `out` holds something else or cannot be written.
    """
    say = progress or (lambda stage, fraction: None)
    check_replaceable(out, MARKER)
    size = size or Size()
    outcomes: list[Outcome] = []
    for k, case in enumerate(cases):
        say(f"{case.n_flowers} flowers, {1000 * case.sigma_m:g} mm", 0.8 * k / len(cases))
        outcomes += run_case(case, contenders(), size, rng=np.random.default_rng([seed, k]))
    say("coverage", 0.8)
    covered = coverage_table(2 * size.n_genuine, rng=np.random.default_rng([seed, 1000]))
    say("recordings", 0.9)
    real, plants = _on_recordings(recordings, rng=np.random.default_rng([seed, 2000]))
    done = Comparison(seed, outcomes, covered, real, plants, out)
    with drawing.style():
        pictures = {f"descriptors.{kind}": drawing.as_bytes(draw(outcomes, covered), kind) for kind in ("png", "svg")}
    write_folder(out, {**_tables(done), **pictures, "index.html": render(done, pictures["descriptors.png"])})
    say("done", 1.0)
    return done


def _on_recordings(folder: Path | None, *, rng: np.random.Generator) -> tuple[list[RealRow], list[PlantRow]]:
    labels = load_plants(folder, "labels") if folder is not None else []
    detected = load_plants(folder, "strict") if folder is not None else []
    real = [row for n in (4, 5) for row in real_rows(labels, n, contenders(), rng=rng)] if labels else []
    return real, plant_rows(labels, detected) if labels and detected else []


def _tables(done: Comparison) -> dict[str, str]:
    files = {
        "descriptors.csv": page.csv_text(OUTCOME_HEADER, [_cells(o) for o in done.outcomes]),
        "coverage.csv": _records(CoverageRow, done.coverage),
        MARKER: json.dumps({"seed": done.seed, "n_cases": len({o.case for o in done.outcomes})}) + "\n",
    }
    if done.real:
        files["real.csv"] = _records(RealRow, done.real)
    if done.plants:
        files["plants.csv"] = _records(PlantRow, done.plants)
    return files


OUTCOME_HEADER = (
    "descriptor",
    "sigma_m",
    "n_flowers",
    "n_missing",
    "n_new",
    "radius_low_m",
    "radius_high_m",
    "false_match_rate",
    "equal_error_rate",
    "rank_1",
    "coverage",
    "us_per_pair",
)


def _cells(o: Outcome) -> tuple[object, ...]:
    case = (o.case.sigma_m, o.case.n_flowers, o.case.n_missing, o.case.n_new, *o.case.radius_m)
    rates = (o.false_match_rate, o.equal_error_rate, o.rank_1, o.coverage)
    return (o.name, *case, *(_number(x, 5) for x in rates), _number(o.us_per_pair, 2))


def _number(value: float, digits: int) -> str:
    return "" if np.isnan(value) else f"{value:.{digits}f}"


def _records(kind: type[CoverageRow | RealRow | PlantRow], rows: Sequence[CoverageRow | RealRow | PlantRow]) -> str:
    header = tuple(f.name for f in fields(kind))
    cells = [[f"{v:.5f}" if isinstance(v, float) else v for v in asdict(row).values()] for row in rows]
    return page.csv_text(header, cells)
