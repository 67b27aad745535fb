"""What a person reads on the terminal: tables of what was found, and warnings."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cluster_slam.records import Result

_ROWS = (
    ("trajectory error", (("ate_rmse_m", "{}"), ("ate_rotation_rad", "{} RMS"))),
    ("identities", (("cluster_idf1", "IDF1 of clusters {}"), ("flower_idf1", "of flowers {}"))),
    ("clutter labels", (("clutter_precision", "precision {}"), ("clutter_recall", "recall {}"))),
    ("flower error", (("flower_rmse_m", "{} RMS"),)),
    ("NEES (1 is true)", (("nees_flowers", "flowers {}"), ("nees_clusters", "clusters {}"))),
    ("hand-eye error", (("hand_eye_m", "{}"), ("hand_eye_rad", "{}"))),
)  # of the summary: each metric with its words


def shown_metric(name: str, value: float) -> str:
    """A metric with the unit that suits it, by the ending of its name."""
    if name.endswith("_rad"):
        return f"{57.29577951308232 * value:.3g} deg"
    if name.endswith("_m"):
        return f"{value:.3g} m" if value >= 1.0 else f"{1e3 * value:.3g} mm"
    return f"{value:.4g}"


def print_json(value: Mapping[str, Any]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(json.dumps(value, indent=2, allow_nan=False) + "\n")


def print_table(title: str, rows: Iterable[tuple[str, str]]) -> None:
    """Names and values on stdout."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    Console().print(table)


def print_warnings(warnings: Iterable[str]) -> None:
    """One line each on stderr."""
    for text in warnings:
        sys.stderr.write(f"warning: {' '.join(text.split())}\n")


def result_rows(result: Result) -> list[tuple[str, str]]:
    """What ``smooth`` found, in words and numbers."""
    n = len(result.flower_ids)
    clutter = int((result.flower_ids < 0).sum())
    states = {s: result.clusters.states.count(s) for s in ("confirmed", "tentative", "lost")}
    words = ", ".join(f"{count} {state}" for state, count in states.items() if count)
    rows = [
        ("session", f"{result.session.id}" + (f" (plant {result.session.plant})" if result.session.plant else "")),
        ("frames", str(result.session.n_frames)),
        ("observations", str(n)),
        ("clusters", f"{len(result.clusters)}" + (f" ({words})" if words else "")),
        ("flowers", str(len(result.flowers))),
        ("clutter", f"{clutter}" + (f" ({100 * clutter / n:.1f} % of the observations)" if n else "")),
    ]
    return rows + _hand_eye_row(result)


def _hand_eye_row(result: Result) -> list[tuple[str, str]]:
    if result.calibration is None or result.session.T_flange_camera is None:
        return []
    import numpy as np

    from cluster_slam.geometry import inverse, se3_log

    xi = se3_log(inverse(result.session.T_flange_camera) @ result.calibration.T_flange_camera)
    shift, turn = np.linalg.norm(xi[3:]), np.linalg.norm(xi[:3])
    text = f"moved by {1e3 * shift:.2f} mm and {np.degrees(turn):.3f} deg from what was measured"
    unobserved = result.calibration.unobserved
    return [("hand-eye", text + (f"; not observable: {', '.join(unobserved)}" if unobserved else ""))]


def truth_rows(metrics: Mapping[str, float]) -> list[tuple[str, str]]:
    """The main metrics in words, one row a subject; what is not known is left out."""
    rows = []
    for subject, parts in _ROWS:
        texts = [words.format(shown_metric(name, metrics[name])) for name, words in parts if name in metrics]
        if texts:
            rows.append((subject, ", ".join(texts)))
    return rows


def metric_rows(metrics: Mapping[str, float]) -> list[tuple[str, str]]:
    """All metrics by the names that ``metrics.json`` has for them."""
    return [(name, shown_metric(name, value)) for name, value in metrics.items()]
