"""The comparison in one figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cluster_slam.compare.contenders import AXES, BOUND, GEOMETRY, PAPER, PAPER_EXACT, RATIO
from cluster_slam.compare.coverage import CoverageRow
from cluster_slam.compare.population import Case
from cluster_slam.compare.trial import Outcome
from cluster_slam.reproduce.drawing import BLUE, GREEN, GREY, OCHRE, RED, SKY, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES: dict[str, dict[str, Any]] = {
    PAPER: {"color": RED, "marker": "o"},
    PAPER_EXACT: {"color": OCHRE, "marker": "v"},
    AXES: {"color": GREEN, "marker": "s"},
    GEOMETRY: {"color": SKY, "marker": "D"},
    RATIO: {"color": BLUE, "marker": "^"},
    BOUND: {"color": "black", "marker": "", "linestyle": "--"},
}
FLOOR = 5e-5  # rates below it are drawn there


def draw(outcomes: Sequence[Outcome], covered: Sequence[CoverageRow]) -> Figure:
    """ROC, false match rates over the count and with missing flowers, coverage over the radius."""
    figure = new_figure(7.2, 5.2)
    axes = figure.subplots(2, 2)
    _roc(axes[0, 0], outcomes)
    _rates(axes[0, 1], outcomes)
    _hard(axes[1, 0], outcomes)
    _coverage(axes[1, 1], covered)
    handles, labels = axes[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _roc(axes: Any, outcomes: Sequence[Outcome]) -> None:
    shown = Case(0.005, 6)
    for outcome in outcomes:
        if outcome.case == shown and outcome.name in STYLES:
            style = {**STYLES[outcome.name], "marker": ""}
            axes.plot(np.maximum(outcome.roc[0], FLOOR), outcome.roc[1], **style)
    axes.axhline(0.95, color=GREY, lw=0.6)
    axes.set_xscale("log")
    axes.set_xlim(1e-3, 1.0)
    axes.set_ylim(0.5, 1.0)
    axes.set_xlabel("false match rate")
    axes.set_ylabel("recall")
    axes.set_title("six flowers, errors of 5 mm")


def _rates(axes: Any, outcomes: Sequence[Outcome]) -> None:
    for sigma, line in ((0.002, "-"), (0.005, ":")):
        for name, style in STYLES.items():
            rows = [o for o in outcomes if o.name == name and _is_plain(o.case) and o.case.sigma_m == sigma]
            x, y = [o.case.n_flowers for o in rows], [max(o.false_match_rate, FLOOR) for o in rows]
            own = {**style, "linestyle": "--" if name == BOUND else line}
            axes.plot(x, y, markersize=4, label=name if sigma == 0.002 else None, **own)
    axes.set_yscale("log")
    axes.set_xticks((3, 4, 5, 6))
    axes.set_xlabel("flowers")
    axes.set_ylabel("false match rate at 95 % recall")
    axes.set_title("errors of 2 mm (solid) and 5 mm (dotted)")


def _is_plain(case: Case) -> bool:
    return not case.n_missing and not case.n_new and case.radius_m == Case(0.0, 0).radius_m


def _hard(axes: Any, outcomes: Sequence[Outcome]) -> None:
    kinds = (
        ("none", Case(0.005, 5)),
        ("one new", Case(0.005, 5, n_new=1)),
        ("one missing", Case(0.005, 5, n_missing=1)),
        ("one each", Case(0.005, 5, n_missing=1, n_new=1)),
    )
    names = [name for name in STYLES if name != BOUND]
    for k, name in enumerate(names):
        rates = {o.case: o.false_match_rate for o in outcomes if o.name == name}
        at = np.arange(len(kinds)) + 0.15 * (k - 0.5 * (len(names) - 1))
        axes.bar(at, [rates.get(case, 0.0) for _, case in kinds], width=0.14, color=STYLES[name]["color"])
    axes.set_xticks(range(len(kinds)), [label for label, _ in kinds])
    axes.set_ylabel("false match rate at 95 % recall")
    axes.set_title("five flowers, errors of 5 mm: missing and new ones")


def _coverage(axes: Any, covered: Sequence[CoverageRow]) -> None:
    for name, style in STYLES.items():
        radii = sorted({row.radius_in_sigmas for row in covered if row.name == name})
        values = [[r.coverage for r in covered if r.name == name and r.radius_in_sigmas == radius] for radius in radii]
        if values:
            axes.plot(radii, [np.mean(v) for v in values], markersize=4, **style)
            axes.fill_between(
                radii, [min(v) for v in values], [max(v) for v in values], color=style["color"], alpha=0.15
            )
    axes.axhline(0.95, color=GREY, lw=0.6)
    axes.set_xscale("log")
    axes.set_xticks((3, 6, 20), ("3", "6", "20"))
    axes.minorticks_off()
    axes.set_xlabel("radius in sigmas")
    axes.set_ylabel("coverage of a nominal 95 % gate")
    axes.set_title("mean and range over 3 to 8 flowers")
