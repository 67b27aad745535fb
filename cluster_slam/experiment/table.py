"""One tidy table of an experiment, and means with confidence intervals of each point of the sweep."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_slam.experiment.plan import Cell, Experiment, Value
from cluster_slam.experiment.tasks import Figures

CONFIDENCE = 0.95
_SHARES = ("located", "wrong_located", "within_1cm_1deg", "cluster_f1", "flower_f1", "wrong_share", "failed")


@dataclass(frozen=True, slots=True)
class Summary:
    """One figure at one point of the sweep, over the seeds."""

    point: tuple[tuple[str, Value], ...]
    figure: str
    n: int
    mean: float
    low: float  # of the confidence interval of the mean (Student's t)
    high: float


def figure_names(rows: Sequence[tuple[Cell, Figures]]) -> list[str]:
    """All figures of any cell, in the order in which they first come."""
    return list(dict.fromkeys(name for _, figures in rows for name in figures))


def table_csv(experiment: Experiment, rows: Sequence[tuple[Cell, Figures]]) -> str:
    """A row for each cell and seed."""
    names, swept = figure_names(rows), [name for name, _ in experiment.sweep]
    lines = [",".join(["task", "preset", *map(_cell, swept), "seed", *names])]
    for cell, figures in rows:
        values = [_number(figures.get(name, float("nan"))) for name in names]
        lines.append(",".join([cell.task, cell.preset, *(_cell(v) for _, v in cell.swept), str(cell.seed), *values]))
    return "\n".join([*lines, ""])


def summaries(rows: Sequence[tuple[Cell, Figures]]) -> list[Summary]:
    """Means and confidence intervals over the seeds."""
    points = list(dict.fromkeys(cell.swept for cell, _ in rows))
    out = []
    for point in points:
        here = [figures for cell, figures in rows if cell.swept == point]
        for name in figure_names(rows):
            values = np.array([f[name] for f in here if np.isfinite(f.get(name, np.nan))])
            mean, low, high = mean_interval(values)
            low, high = (float(np.clip(x, 0.0, 1.0 if is_share(name) else np.inf)) for x in (low, high))
            out.append(Summary(point, name, len(values), mean, low, high))
    return out


def is_share(figure: str) -> bool:
    """Whether a figure is a share, 0 to 1; all others are 0 or more."""
    return figure in _SHARES or figure.endswith(("idf1", "hota", "_precision", "_recall"))


def mean_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean and its confidence interval by Student's t; NaN where there are too few values."""
    from scipy.special import stdtrit

    if len(values) == 0:
        return (float("nan"),) * 3
    mean = float(values.mean())
    if len(values) == 1:
        return mean, float("nan"), float("nan")
    half = float(stdtrit(len(values) - 1, 0.5 + CONFIDENCE / 2) * values.std(ddof=1) / np.sqrt(len(values)))
    return mean, mean - half, mean + half


def summary_csv(experiment: Experiment, found: Sequence[Summary]) -> str:
    """A row for each point of the sweep and figure."""
    lines = [",".join([*(_cell(name) for name, _ in experiment.sweep), "figure", "n", "mean", "low", "high"])]
    for s in found:
        numbers = [_number(x) for x in (s.mean, s.low, s.high)]
        lines.append(",".join([*(_cell(v) for _, v in s.point), s.figure, str(s.n), *numbers]))
    return "\n".join([*lines, ""])


def _number(x: float) -> str:
    return "" if x != x else f"{x:.9g}"


def _cell(value: Value) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text
