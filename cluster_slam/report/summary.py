"""The summary in words, and the tiles of figures beside it."""

from __future__ import annotations

from dataclasses import dataclass

from cluster_slam.evaluation import Metrics
from cluster_slam.records import Result
from cluster_slam.report.findings import MUCH_REJECTED, Level
from cluster_slam.report.statistics import Summary
from cluster_slam.report.words import REASON_WORDS, angle, count, digits, duration, length, share


@dataclass(frozen=True, slots=True)
class Tile:
    """One figure that a reader should take away."""

    label: str
    value: str
    detail: str
    tip: str  # what the figure means
    level: Level | None = None  # bad or warn where the figure is a cause for concern


def headline(summary: Summary) -> str:
    """One sentence: what was found."""
    if not summary.n_flowers:
        return "No flowers were mapped"
    parts = [count(summary.n_clusters, "cluster")] if summary.n_clusters or not summary.n_single else []
    if summary.n_single:
        parts.append(count(summary.n_single, "single flower"))
    flowers = f" with {count(summary.n_flowers, 'flower')}" if not summary.n_single else ""
    total = f", {count(summary.n_flowers, 'flower')} in all" if summary.n_single and summary.n_clusters else ""
    return f"{' and '.join(parts)}{flowers}{total}"


def sentences(result: Result, summary: Summary) -> tuple[str, ...]:
    """A short paragraph for a reader who has never seen such a page."""
    detections = f"{count(summary.n_observations, 'detection')} of flowers"
    out = [
        f"A camera looked at the plant for {duration(summary.seconds)} ({summary.n_frames:,} pictures, {detections})."
    ]
    if summary.n_frames == 1:
        out = [f"One picture was taken, with {detections}: nothing in it could be confirmed by a second look."]
    if summary.radius95_m is not None and summary.worst_radius95_m is not None and summary.sigma_m is not None:
        out.append(
            f"A typical cluster's centre is known to within {length(summary.radius95_m)} with 95 % probability, "
            f"the least certain one to within {length(summary.worst_radius95_m)}."
        )
    if summary.n_rejected and summary.rejected:
        reason, n = summary.rejected[0]
        most = "all" if n == summary.n_rejected else f"most often ({n:,})"
        out.append(
            f"{count(summary.n_rejected, 'detection')} ({share(summary.n_rejected, summary.n_observations)}) "
            f"were taken for false, {most} because {_lower_first(REASON_WORDS[reason].sentence)}"
        )
    if summary.hand_eye_m is not None and summary.hand_eye_rad is not None:
        out.append(
            f"The camera turned out to be mounted {length(summary.hand_eye_m)} and {angle(summary.hand_eye_rad)} from "
            "where the session said."
        )
    return tuple(out)


def tiles(result: Result, summary: Summary) -> tuple[Tile, ...]:
    """The figures, most important first."""
    certain = Tile(
        "How sure is the map",
        "unknown" if summary.radius95_m is None else f"± {length(summary.radius95_m)}",
        "" if summary.sigma_m is None else f"95 %; one standard deviation {length(summary.sigma_m)}",
        "With 95 % probability the true centre of a typical cluster lies within this distance of where the map has it.",
    )
    rejected = Tile(
        "Rejected detections",
        share(summary.n_rejected, summary.n_observations),
        f"{summary.n_rejected:,} of {summary.n_observations:,}",
        "Detections that were taken for false: no flower of the map caused them.",
        "warn" if summary.n_rejected > MUCH_REJECTED * summary.n_observations else None,
    )
    return (_found(summary), certain, rejected, *_path(summary), *_mount(summary), *_fit(summary))


def _found(summary: Summary) -> Tile:
    unsure = f", {summary.n_unsure} unconfirmed" if summary.n_unsure else ""
    single = f"and {count(summary.n_single, 'single flower')}; " if summary.n_single and summary.n_clusters else ""
    name, n = (
        ("Clusters", summary.n_clusters)
        if summary.n_clusters or not summary.n_single
        else ("Flowers", summary.n_single)
    )
    return Tile(
        name,
        f"{n:,}",
        f"{single}{count(summary.n_flowers, 'flower')}{' in all' if single else ''}{unsure}",
        "A cluster is a group of flowers that stand and move together.",
        "bad" if not summary.n_flowers else ("warn" if summary.n_unsure else None),
    )


def _path(summary: Summary) -> tuple[Tile, ...]:
    if summary.path_shift_m is None or summary.path_turn_rad is None:
        return ()
    tip = "Root mean square difference between the camera poses that the session gave and those that fit what was seen."
    return (Tile("Camera path corrected by", length(summary.path_shift_m), f"and {angle(summary.path_turn_rad)}", tip),)


def _mount(summary: Summary) -> tuple[Tile, ...]:
    if summary.hand_eye_m is None or summary.hand_eye_rad is None:
        return ()
    tip = "How far the camera's place on the robot (the hand-eye transform) was from what the session stated."
    return (Tile("Camera mount off by", length(summary.hand_eye_m), f"and {angle(summary.hand_eye_rad)}", tip),)


def _fit(summary: Summary) -> tuple[Tile, ...]:
    if summary.misfit is None:
        return ()
    good = abs(summary.misfit - 1.0) <= 0.2
    detail = (
        "as it should be" if good else ("the map is too confident" if summary.misfit > 1 else "the map is cautious")
    )
    tip = (
        "Mean squared misfit of the accepted detections over what their stated certainty leads one to expect. 1: the "
        "uncertainties are true; above: too small; below: too large."
    )
    level: Level | None = None if good or summary.misfit < 1 else ("bad" if summary.misfit > 2.0 else "warn")
    return (Tile("Misfit against expectation", digits(summary.misfit), detail, tip, level),)


@dataclass(frozen=True, slots=True)
class Score:
    """A figure of the comparison with ground truth."""

    label: str
    value: str
    tip: str


def scores(metrics: Metrics | None) -> tuple[Score, ...]:
    """What the comparison with the truth gave, in words."""
    if metrics is None:
        return ()
    rows = (
        ("Detections with the right cluster", _percent(metrics.cluster_idf1), "IDF1 of the cluster ids."),
        ("Detections with the right flower", _percent(metrics.flower_idf1), "IDF1 of the flower ids."),
        ("False detections recognised", _percent(metrics.clutter_recall), "Recall of the label 'false'."),
        ("Rejections that were right", _percent(metrics.clutter_precision), "Precision of the label 'false'."),
        ("Flowers, error", _length(metrics.flower_rmse_m), "Root mean square distance from their true rest positions."),
        ("Clusters, error", _length(metrics.cluster_rmse_m), "Root mean square distance from the mean of the members."),
        ("Camera path, error", _length(metrics.ate_rmse_m), "Root mean square distance after alignment (ATE)."),
        ("Camera path as given, error", _length(metrics.ate_rmse_given_m), "The same for the poses that came in."),
        ("Camera mount, error", _length(metrics.hand_eye_m), "Error of the hand-eye translation."),
        (
            "Flowers inside their 95 % ellipsoid",
            _percent(metrics.inside95_flowers),
            "95 % if the covariances are true.",
        ),
        ("Clusters inside their 95 % ellipsoid", _percent(metrics.inside95_clusters), "95 % if they are true."),
        ("Flowers, squared error over expected", _number(metrics.nees_flowers), "NEES / 3: 1 if covariances are true."),
        ("Clusters that do not exist", _number(metrics.n_ghost_clusters), "Confirmed, but without a true flower."),
    )
    return tuple(Score(label, value, tip) for label, value, tip in rows if value)


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.2f} %".replace("100.00", "100")


def _length(value: float | None) -> str:
    return "" if value is None else length(value)


def _number(value: float | None) -> str:
    return "" if value is None else digits(value)


def _lower_first(text: str) -> str:
    return text[:1].lower() + text[1:]
