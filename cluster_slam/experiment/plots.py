"""The plots a paper would show: each figure over the first swept option, a line for each value of the others."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

from cluster_slam.experiment.plan import Experiment
from cluster_slam.experiment.table import Summary

_HIDDEN = {"seconds"}


def plots(experiment: Experiment, found: Sequence[Summary]) -> dict[str, bytes]:
    """Pictures by file name, PNG and SVG; none where nothing is swept."""
    if not experiment.sweep:
        return {}
    names = [n for n in dict.fromkeys(s.figure for s in found) if n not in _HIDDEN]
    out: dict[str, bytes] = {}
    for name in names:
        out |= _plot(experiment, name, [s for s in found if s.figure == name and math.isfinite(s.mean)])
    return out


def _plot(experiment: Experiment, name: str, found: Sequence[Summary]) -> dict[str, bytes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.8, 3.2), layout="constrained")
    axes = figure.add_subplot()
    first = experiment.sweep[0][0]
    lines = list(dict.fromkeys(s.point[1:] for s in found))
    numeric = all(isinstance(s.point[0][1], int | float) and not isinstance(s.point[0][1], bool) for s in found)
    ticks = {value: i for i, value in enumerate(experiment.sweep[0][1])}
    places = [float(v) if numeric else float(ticks[v]) for v in ticks]
    aside = 0.01 * (max(places) - min(places))  # so that the bars of several lines can be told apart
    for k, line in enumerate(lines):
        here = [s for s in found if s.point[1:] == line]
        x = [float(s.point[0][1]) if numeric else float(ticks[s.point[0][1]]) for s in here]
        x = [at + aside * (k - 0.5 * (len(lines) - 1)) for at in x]
        known = [(s.mean - s.low, s.high - s.mean) if math.isfinite(s.low) else (0.0, 0.0) for s in here]
        label = ", ".join(f"{n} = {v}" for n, v in line)
        axes.errorbar(
            x, [s.mean for s in here], yerr=list(zip(*known, strict=True)), marker="o", capsize=3, label=label
        )
    if not numeric:
        axes.set_xticks(list(ticks.values()), [str(v) for v in ticks])
    axes.set_xlabel(first)
    axes.set_ylabel(name)
    axes.grid(alpha=0.3)
    if lines and lines[0]:
        axes.legend(fontsize="small")
    out = {}
    for kind in ("png", "svg"):
        buffer = io.BytesIO()
        metadata = {"Date": None} if kind == "svg" else None
        figure.savefig(buffer, format=kind, dpi=150, metadata=metadata)
        out[f"{name}.{kind}"] = buffer.getvalue()
    return out
