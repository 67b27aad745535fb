"""The report: one page that holds all it needs and asks nothing of the network."""

from __future__ import annotations

import html
import json
import math
import re
from dataclasses import asdict
from importlib import resources

import numpy as np

from cluster_slam.evaluation import Metrics
from cluster_slam.geometry import so3_log
from cluster_slam.records import RejectReason, Result
from cluster_slam.report.findings import NOISE_WORDS, find
from cluster_slam.report.pack import rounded
from cluster_slam.report.scene import scene_json
from cluster_slam.report.statistics import Summary, coverage_curves, hand_eye_correction, misfit_curve, summarise
from cluster_slam.report.summary import headline, scores, sentences, tiles
from cluster_slam.report.words import REASON_WORDS

_SCRIPTS = (
    "state.js",
    "format.js",
    "data.js",
    "view.js",
    "scene.js",
    "chart.js",
    "table.js",
    "detail.js",
    "words.js",
    "controls.js",
    "start.js",
)


def render_report(result: Result, metrics: Metrics | None = None) -> str:
    """The page of a result as one HTML text.

    Parameters
    ----------
    result : Result
        What ``smooth`` or ``track`` gave, in memory.
    metrics : Metrics, optional
        The comparison with ground truth, where there is one.

    Notes
    -----
    The page opens from disk, loads nothing (a content security policy forbids it), and stays under 8 MB: of more
    than 300,000 observations only those of every second (third ...) frame are in it.
    """
    parts = {
        "title": html.escape(f"{result.session.id}: flower map"),
        "style": _asset("style.css"),
        "script": "\n".join(_asset(name) for name in _SCRIPTS),
        "data": _json(page_json(result, metrics)),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _asset("page.html"))


def page_json(result: Result, metrics: Metrics | None) -> dict[str, object]:
    """All that the page shows, as JSON."""
    summary = summarise(result)
    return {
        "session": result.session.id,
        "plant": result.session.plant,
        "command": result.command,
        "status": result.status,
        "headline": headline(summary),
        "sentences": sentences(result, summary),
        "tiles": [asdict(tile) for tile in tiles(result, summary)],
        "findings": [asdict(finding) for finding in find(result, summary, metrics)],
        "scores": [asdict(score) for score in scores(metrics)],
        "reasons": [asdict(REASON_WORDS[reason]) for reason in RejectReason],
        "rejected": [[int(reason), n] for reason, n in summary.rejected],
        "accepted": summary.n_observations - summary.n_rejected,
        "misfit": _misfit(result, summary),
        "coverage": [asdict(curve) for curve in coverage_curves(result, metrics)],
        "noise": _noise(result),
        "calibration": _calibration(result),
        "run": _run(result),
        "scene": scene_json(result),
    }


def _misfit(result: Result, summary: Summary) -> dict[str, object]:
    curve = misfit_curve(result)
    columns = {"t": curve.times, "mean": curve.mean / 3, "low": curve.low / 3, "high": curve.high / 3}
    out: dict[str, object] = {name: rounded(values, 4) for name, values in columns.items()}
    return out | {"n": curve.n.tolist(), "inside": curve.share_inside, "all": summary.misfit}


def _noise(result: Result) -> list[dict[str, object]]:
    """Stated beside estimated standard deviations; names that the session does not know have no stated one."""
    return [
        {
            "name": NOISE_WORDS.get(name, name.replace("_", " ")),
            "key": name,
            "stated": getattr(result.session.noise, name, None),
            "estimated": value,
            "unit": _noise_unit(name),
        }
        for name, value in sorted(result.diagnostics.estimated_noise.items())
        # A factor is the ratio of the row that it belongs to; a power of depth is no standard deviation.
        if not name.endswith("_factor") and not name.startswith("flower_power_")
    ]


def _noise_unit(name: str) -> str:
    if name == "pixel":
        return "px"
    if name.startswith("odometry") or name.endswith("_share"):
        return "ratio"
    if name.endswith("rotation"):
        return "rad"
    return "depth" if name == "depth" else "m"


def _calibration(result: Result) -> dict[str, object] | None:
    xi = hand_eye_correction(result)
    if xi is None or result.calibration is None or result.session.T_flange_camera is None:
        return None
    stated = result.session.noise
    given, found = result.session.T_flange_camera, result.calibration.T_flange_camera
    return {
        "correction": rounded(xi, 9),
        "sigma": rounded(np.sqrt(np.diag(result.calibration.cov)), 9),
        "stated": [stated.hand_eye_rotation] * 3 + [stated.hand_eye_translation] * 3,
        "before": rounded(np.concatenate([so3_log(given[:3, :3]), given[:3, 3]]), 9),
        "after": rounded(np.concatenate([so3_log(found[:3, :3]), found[:3, 3]]), 9),
        "unobserved": list(result.calibration.unobserved),
    }


def _run(result: Result) -> dict[str, object]:
    from cluster_slam import __version__

    return {
        "version": __version__,
        "seed": result.seed,
        "timings": result.timings_s,
        "counts": result.counts,
        "config": result.config,
        "pose_error": result.session.pose_error,
        "pose_frame": result.session.pose_frame,
    }


def _json(value: object) -> str:
    """JSON that may stand inside a script element: no ``<``, no NaN."""
    return json.dumps(_finite(value), ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace(
        "<", "\\u003c"
    )


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _asset(name: str) -> str:
    return (resources.files("cluster_slam.report") / "assets" / name).read_text(encoding="utf-8")
