"""What a person reads on the terminal: tables of what was found, and warnings."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cluster_slam.records import Result

_LENGTHS = {"_m": (1e3, "mm"), "_rad": (57.29577951308232, "deg")}  # unit of a name's ending: factor, unit shown
_SUBJECTS = (
    ("trajectory error", (("ate_rmse_m", 1e3, "{:.3g} mm"), ("ate_rotation_rad", 57.2958, "{:.3g} deg RMS"))),
    ("identities", (("cluster_idf1", 1, "IDF1 of clusters {:.4f}"), ("flower_idf1", 1, "of flowers {:.4f}"))),
    ("clutter labels", (("clutter_precision", 1, "precision {:.3f}"), ("clutter_recall", 1, "recall {:.3f}"))),
    ("flower error", (("flower_rmse_m", 1e3, "{:.3g} mm RMS"),)),
    ("NEES (1 is true)", (("nees_flowers", 1, "flowers {:.3g}"), ("nees_clusters", 1, "clusters {:.3g}"))),
    ("hand-eye error", (("hand_eye_m", 1e3, "{:.3g} mm"), ("hand_eye_rad", 57.2958, "{:.3g} deg"))),
)  # a row of the summary: metric, factor to the unit shown, words


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
    for subject, parts in _SUBJECTS:
        texts = [words.format(metrics[name] * factor) for name, factor, words in parts if name in metrics]
        if texts:
            rows.append((subject, ", ".join(texts)))
    return rows


def metric_rows(metrics: Mapping[str, float]) -> list[tuple[str, str]]:
    """Metrics by name, lengths in millimetres and angles in degrees."""
    return [_metric(name, value) for name, value in metrics.items()]


def _metric(name: str, value: float) -> tuple[str, str]:
    for ending, (factor, unit) in _LENGTHS.items():
        if name.endswith(ending):
            what = "_rotation" if unit == "deg" and "rotation" not in name else ""
            return name.removesuffix(ending) + what, f"{factor * value:.4g} {unit}"
    return name, f"{value:.6g}"
