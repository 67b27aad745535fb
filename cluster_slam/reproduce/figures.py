"""Figures 2 to 8 of the paper in our own drawing, and one of table I."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cluster_slam.descriptors import inertia_and_mean_distance, isotropic, unscented_moments
from cluster_slam.geometry import Array
from cluster_slam.reproduce import drawing
from cluster_slam.reproduce.settings import PAPER_TABLE_1, PROBABILITY, Settings
from cluster_slam.reproduce.table1 import NoiseRow
from cluster_slam.reproduce.table3 import Recording, matches, random_cluster
from tracking.gating import chi2_threshold, mahalanobis_sq

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN_FRAMES = 300
PIPELINE = (
    ("detections", "pixels and depth"),
    ("flowers", "3-D points, world frame"),
    ("cluster", "inertia I,\nmean distance D"),
    ("sigma points", "unscented transform:\nmean and covariance"),
    ("gate", "d² < χ²(0.95, 2)\nand equal counts"),
    ("match", "same cluster"),
)


def figure_files(settings: Settings, rows: Sequence[NoiseRow], data: Sequence[Recording]) -> dict[str, bytes]:
    """All figures as PNG by file name."""
    by_name = {recording.name: recording for recording in data}
    with drawing.style():
        figures = {
            "figure2": _descriptor(),
            "figure3": _pipeline(),
            "figure4": _datasets(data),
            "figure5": _case(settings, by_name["Data1"], by_name["Data1"], True, "Three flowers, matched"),
            "figure6": _case(settings, by_name["Data1"], by_name["Data2"], False, "Three flowers, not matched"),
            "figure7": _case(settings, by_name["Data3"], by_name["Data4"], True, "Four flowers, matched"),
            "figure8": _case(settings, by_name["Data3"], by_name["Data4"], False, "Four flowers, not matched"),
            "table1": _table1(settings, rows),
        }
        return {f"{name}.png": drawing.as_bytes(figure) for name, figure in figures.items()}


def _descriptor() -> Figure:
    """Figure 2: six flowers and their distances to the centroid."""
    points = random_cluster(6, rng=np.random.default_rng(3))
    figure = drawing.new_figure(3.6, 3.2)
    axes: Any = figure.add_subplot(projection="3d")
    drawing.draw_flowers(axes, points, drawing.BLUE)
    inertia, distance = inertia_and_mean_distance(points)
    axes.set_title(f"I = {1e4 * inertia:.1f} cm², D = {100 * distance:.2f} cm")
    drawing.equal_box(axes, points)
    return figure


def _pipeline() -> Figure:
    """Figure 3: from detections to a match."""
    figure = drawing.new_figure(7.2, 1.3)
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_xlim(-0.5, len(PIPELINE) - 0.5)
    axes.set_ylim(-1, 1)
    box: Any = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": drawing.BLUE}
    for k, (name, text) in enumerate(PIPELINE):
        axes.text(k, 0.45, name, ha="center", va="center", bbox=box, fontsize=7)
        axes.text(k, -0.4, text, ha="center", va="center", fontsize=6, color=drawing.GREY)
        if k:
            axes.annotate("", (k - 0.42, 0.45), (k - 0.62, 0.45), arrowprops={"arrowstyle": "->", "lw": 0.8})
    return figure


def _datasets(data: Sequence[Recording]) -> Figure:
    """Figure 4: where the flowers of the four recordings were."""
    figure = drawing.new_figure(7.0, 6.4)
    for k, recording in enumerate(data):
        axes: Any = figure.add_subplot(2, 2, k + 1, projection="3d")
        step = max(1, len(recording.frames) // SHOWN_FRAMES)
        frames = recording.frames[::step]
        for flower, colour in enumerate(drawing.COLOURS[: recording.rest.shape[0]]):
            axes.scatter(*(100.0 * frames[:, flower].T), s=2, color=colour, alpha=0.35, linewidths=0)
        drawing.draw_flowers(axes, recording.rest, "black", size=10)
        drawing.equal_box(axes, np.concatenate([frames.reshape(-1, 3), recording.rest]))
        axes.set_title(f"{recording.name}: {len(recording.frames)} frames (emulated)")
    return figure


def _case(settings: Settings, reference: Recording, observed: Recording, is_match: bool, title: str) -> Figure:
    """Figures 5 to 8: a frame that passes the reference's gate, or one that does not."""
    rest, frames = reference.rest, observed.frames
    passed = matches(settings, rest, frames)
    which = np.flatnonzero(passed == is_match)
    frame = frames[which[len(which) // 2]] if len(which) else frames[0]
    figure = drawing.new_figure(6.8, 2.9)
    left: Any = figure.add_subplot(1, 2, 1, projection="3d")
    drawing.draw_flowers(left, rest, drawing.BLUE, f"{reference.name}, reference")
    shown = frame - frame.mean(0) + rest.mean(0)
    drawing.draw_flowers(left, shown, drawing.RED, f"{observed.name}, observed")
    drawing.equal_box(left, np.concatenate([rest, shown]))
    left.legend(loc="upper left")
    _gate_plot(figure.add_subplot(1, 2, 2), settings, rest, frames, frame, title)
    return figure


def _gate_plot(axes: Any, settings: Settings, rest: Array, frames: Array, frame: Array, title: str) -> None:
    unit = np.array([1e4, 1e2])  # cm^2, cm
    mean, cov = unscented_moments(rest, isotropic(len(rest), settings.noise), settings.rule)
    values, value = inertia_and_mean_distance(frames), inertia_and_mean_distance(frame)
    axes.scatter(*(unit * values).T, s=3, color=drawing.GREY, alpha=0.4, linewidths=0, label="all observed frames")
    axes.plot(*(unit * drawing.ellipse(mean, cov, chi2_threshold(2, PROBABILITY))).T, color=drawing.BLUE, label="gate")
    axes.scatter(*(unit * value), s=40, marker="x", color=drawing.RED, label="this frame", zorder=3)
    axes.set_xlabel("inertia [cm²]")
    axes.set_ylabel("mean distance [cm]")
    distance_sq = float(mahalanobis_sq(value - mean, cov))
    axes.set_title(f"{title}: d² = {distance_sq:.2f}, threshold {chi2_threshold(2, PROBABILITY):.2f}")
    axes.legend()


def _table1(settings: Settings, rows: Sequence[NoiseRow]) -> Figure:
    """Table I as curves: what is the transform's error and what is the sampling's."""
    figure = drawing.new_figure(6.8, 2.6)
    left, right = figure.subplots(1, 2)
    noise = [1000.0 * row.noise for row in rows]
    left.semilogy(noise, [r.frobenius_norm for r in rows], "o-", color=drawing.BLUE, label="transform - Monte Carlo")
    left.semilogy(noise, [r.transform_error for r in rows], "--", color=drawing.RED, label="transform - exact")
    left.semilogy(noise, [r.sampling_error for r in rows], ":", color=drawing.GREEN, label="Monte Carlo - exact")
    right.plot(noise, [r.outlier_percent for r in rows], "o-", color=drawing.BLUE, label="gate of the transform")
    right.plot(noise, [r.exact_outlier_percent for r in rows], ":", color=drawing.GREEN, label="gate of exact moments")
    if settings.is_paper:
        left.semilogy(noise, [f for f, _ in PAPER_TABLE_1], "kx", label="paper")
        right.plot(noise, [p for _, p in PAPER_TABLE_1], "kx", label="paper")
    left.set_ylabel("Frobenius norm")
    right.set_ylabel("outliers [%]")
    for axes in (left, right):
        axes.set_xlabel("noise [mm]")
        axes.legend()
    return figure
