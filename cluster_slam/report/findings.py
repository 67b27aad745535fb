"""What went wrong, or may have: judged from the result itself, in words for somebody who did not make it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from cluster_slam.evaluation import Metrics
from cluster_slam.records import Result
from cluster_slam.report.statistics import Summary, fit_of
from cluster_slam.report.words import count, digits, length, share
from tracking.consistency import mean_band

Level = Literal["bad", "warn", "note"]

MUCH_REJECTED = 0.3  # share of detections, above which the detector or the result deserves a look
_NOISE_FACTOR = 1.25  # an estimated sigma further than this from the stated one is worth a word
_MISFIT_SLACK = 0.2  # how far the mean misfit may be from 1 before it matters in practice
_LOOSE_MISFIT = 2.0  # a cluster whose misfit is this many times the typical one is named
_ENOUGH = 20  # detections, from which a cluster's misfit says anything
_ENOUGH_ALONE = 5  # single flowers, from which it is odd that none of them are a cluster
_LOOSE_FACTOR = 5.0  # a cluster this much less certain than the typical one is named


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing to know, in one or two sentences."""

    level: Level
    text: str


def find(result: Result, summary: Summary, metrics: Metrics | None) -> tuple[Finding, ...]:
    """All that is worth a warning, worst first."""
    parts = (
        _status(result, summary),
        _grouping(summary),
        _rejection(summary),
        _consistency(result, summary),
        _loose_clusters(result),
        _certainty(result, summary),
        _calibration(result),
        _noise(result),
        _against_truth(metrics),
    )
    found = [finding for part in parts for finding in part]
    said = {f"hand-eye: {x}" for x in result.calibration.unobserved} if result.calibration is not None else set()
    others = dict.fromkeys(text for text in (*result.session.warnings, *result.warnings) if text not in said)
    found += [Finding("warn", _sentence(text)) for text in others]
    order: list[Level] = ["bad", "warn", "note"]
    return tuple(sorted(found, key=lambda finding: order.index(finding.level)))


def _status(result: Result, summary: Summary) -> Iterator[Finding]:
    if result.status == "poor":
        yield Finding("bad", "The program itself calls this result poor: do not rely on it before the causes below.")
    if summary.n_flowers == 0:
        yield Finding("bad", "No flower was confirmed, so there is no map.")
    if summary.n_unsure:
        yield Finding("warn", f"{count(summary.n_unsure, 'cluster')} could not be confirmed and may not exist.")
    if result.merged:
        landmarks = count(len(result.merged), "landmark was", "landmarks were")
        yield Finding("note", f"{landmarks} found twice at first, and merged.")


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def _grouping(summary: Summary) -> Iterator[Finding]:
    if summary.n_single >= _ENOUGH_ALONE and not summary.n_clusters:
        yield Finding("warn", "No two flowers were taken for one cluster: where the plant has clusters, their flowers "
                      "were seen too badly, or moved too little, to tell which belong together.")  # fmt: skip


def _rejection(summary: Summary) -> Iterator[Finding]:
    if summary.n_observations and summary.n_rejected > MUCH_REJECTED * summary.n_observations:
        part = share(summary.n_rejected, summary.n_observations)
        yield Finding("warn", f"{part} of all detections were rejected. Either the detector sees much that is not there"
                      ", or flowers were missed by the map.")  # fmt: skip


def _consistency(result: Result, summary: Summary) -> Iterator[Finding]:
    if summary.misfit is None:
        return
    n = int(np.isfinite(result.diagnostics.nis).sum())
    band = mean_band(3, n)
    if band.low / 3 <= summary.misfit <= band.high / 3 or abs(summary.misfit - 1.0) <= _MISFIT_SLACK:
        return
    level: Level = "bad" if summary.misfit > 2.0 else "warn"
    if summary.misfit > 1.0:
        times = digits(float(np.sqrt(summary.misfit)))
        yield Finding(level, f"Detections scatter {times} times as much as the program accounts for: "
                      "the stated certainty is too good.")  # fmt: skip
    else:
        times = digits(float(1.0 / np.sqrt(summary.misfit)))
        yield Finding("note", f"Detections scatter {times} times less than the program accounts for: "
                      "the map is better than it says.")  # fmt: skip


def _loose_clusters(result: Result) -> Iterator[Finding]:
    fit = fit_of(result, result.clusters.ids, result.cluster_ids)
    typical = float(np.nanmedian(fit.misfit)) if fit.n.any() else 1.0
    loose = np.flatnonzero((fit.misfit > _LOOSE_MISFIT * max(typical, 1.0)) & (fit.n >= _ENOUGH))
    for j in loose[np.argsort(-fit.misfit[loose], kind="stable")][:3]:
        times = digits(float(np.sqrt(fit.misfit[j] / max(typical, 1.0))))
        text = f"Cluster {result.clusters.ids[j]} does not hold together: its detections scatter {times} times as much"
        yield Finding("warn", f"{text} as those of others. It may be two clusters taken for one.")


def _certainty(result: Result, summary: Summary) -> Iterator[Finding]:
    worst, typical = summary.worst_radius95_m, summary.radius95_m
    if worst is None or typical is None or worst <= _LOOSE_FACTOR * typical:
        return
    seen = count(int((result.cluster_ids == summary.worst_cluster).sum()), "time")
    yield Finding("warn", f"Cluster {summary.worst_cluster} is known to {length(worst)} only, "
                  f"against {length(typical)} for a typical one; it was seen {seen}.")  # fmt: skip


def _calibration(result: Result) -> Iterator[Finding]:
    if result.calibration is not None and result.calibration.unobserved:
        directions = ", ".join(result.calibration.unobserved)
        yield Finding("warn", f"The motion of the camera does not determine where it sits on the robot ({directions}): "
                      "there the value of the session was kept.")  # fmt: skip


def _noise(result: Result) -> Iterator[Finding]:
    stated = result.session.noise
    for name, value in sorted(result.diagnostics.estimated_noise.items()):
        claim = getattr(stated, name, None)
        if not claim or not value > 0:
            continue
        ratio = value / claim
        if max(ratio, 1 / ratio) > _NOISE_FACTOR:
            than = f"{digits(ratio)} times" if ratio > 1 else f"only {digits(100 * ratio)} % of"
            yield Finding("note", f"The errors of {NOISE_WORDS.get(name, name)} are {than} what the session states.")


NOISE_WORDS = {
    "pose_translation": "the robot's position",
    "pose_rotation": "the robot's orientation",
    "odometry_translation": "the distance travelled",
    "odometry_rotation": "the angle turned",
    "hand_eye_translation": "the camera's place on the robot",
    "hand_eye_rotation": "the camera's orientation on the robot",
    "flower": "a flower's position in one picture",
    "flower_depth": "the depth of a flower 1 m away",
    "flower_lateral": "the place across the view of a flower 1 m away",
    "pixel": "a flower's place in the picture",
    "depth": "the measured depth",
    "sway": "the plant's sway",
    "wild_share": "single detections, share with wild errors",
}


def _against_truth(metrics: Metrics | None) -> Iterator[Finding]:
    if metrics is None:
        return
    if metrics.n_ghost_clusters:
        yield Finding("bad", f"{count(metrics.n_ghost_clusters, 'cluster')} of the map do not exist in truth, "
                      "or are there twice.")  # fmt: skip
    if metrics.n_clusters_true and metrics.n_clusters_found is not None:
        missed = metrics.n_clusters_true - metrics.n_clusters_found
        if missed > 0:
            yield Finding("bad", f"{missed} of {count(metrics.n_clusters_true, 'true cluster')} were not found.")
    if metrics.cluster_idf1 is not None and metrics.cluster_idf1 < 0.99:
        wrong = digits(100 * (1 - metrics.cluster_idf1))
        yield Finding("bad", f"About {wrong} % of detections carry the wrong cluster, by the truth of the session.")
    if metrics.nees_flowers is not None and metrics.nees_flowers > 2.0:
        times = digits(float(np.sqrt(metrics.nees_flowers)))
        yield Finding("bad", f"Flowers are {times} times further from the truth than the map claims.")
