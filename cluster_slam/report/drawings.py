"""The figures themselves: a result in, a matplotlib figure out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cluster_slam.geometry import Array, so3_log
from cluster_slam.records import CLUTTER, IntArray, Result
from cluster_slam.report.colours import PALETTE, colour_indices
from cluster_slam.report.scene import up_axis
from cluster_slam.report.statistics import coverage_curves, misfit_curve, radius95, sway
from cluster_slam.report.words import length
from tracking.gating import chi2_threshold

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH = 7.0  # inches
_INK, _SOFT, _BAND = "#1d2327", "#8a9197", "#0072b222"
_MAGNIFY = (1, 2, 5, 10, 20, 50, 100)
_MOVERS = 4
_MANY = 40  # clusters, above which ids are left out of the map


def draw_map(result: Result) -> Figure | None:
    """Flowers and clusters with their 95 % ellipsoids, from the camera's side and from the plant's right."""
    if not len(result.flowers):
        return None
    axes_of = _axes(result)
    centre = result.flowers.positions.mean(0)
    extent = np.ptp((result.flowers.positions - centre) @ axes_of.T, axis=0)
    right, away, up = np.maximum(extent, 0.25 * extent.max() + 1e-3) * 1.2
    height = float(np.clip((_WIDTH - 1.0) * up / (right + away) + 0.6, 1.8, 8.0))
    figure, (front, side) = _figure(1, 2, height, widths=(float(right), float(away)))
    factor = _magnification(result, float(right + away))
    for axes, rows, label in ((front, (0, 2), "to the right"), (side, (1, 2), "away from the camera")):
        _map_view(axes, result, axes_of[list(rows)], centre, factor)
        axes.set_xlabel(f"{label} (m)")
    side.sharey(front)
    side.tick_params(labelleft=False)
    front.set_ylabel("up (m)")
    enlarged = "" if factor == 1 else f", drawn {factor} times larger"
    front.set_title(f"95 % ellipsoids{enlarged}", loc="left")
    return figure


def _axes(result: Result) -> Array:
    """Rows (3, 3): right, away from the camera, up, as the camera on average looks at the plant."""
    up = np.array(up_axis(result.T_world_camera))
    away = result.flowers.positions.mean(0) - result.T_world_camera[:, :3, 3].mean(0)
    away = away - up * (away @ up)
    if np.linalg.norm(away) < 1e-9:
        away = result.T_world_camera[:, :3, 2].mean(0)
        away = away - up * (away @ up)
    away = away / max(float(np.linalg.norm(away)), 1e-12)
    return np.stack([np.cross(away, up), away, up])


def _magnification(result: Result, width: float) -> int:
    """The largest round factor under which a typical ellipsoid stays below 4 % of the map's width."""
    wanted = 0.04 * width / max(float(np.median(radius95(result.flowers.covs))), 1e-12)
    return max(factor for factor in _MAGNIFY if factor <= max(wanted, 1))


def _map_view(axes: Axes, result: Result, rows: Array, centre: Array, factor: int) -> None:
    colours = colour_indices(result.clusters.positions)
    where = np.searchsorted(result.clusters.ids, result.flowers.cluster_ids)
    flowers = (result.flowers.positions - centre) @ rows.T
    middle = (result.clusters.positions - centre) @ rows.T
    for i, j in enumerate(where):
        colour = PALETTE[colours[j]]
        axes.plot(*np.stack([middle[j], flowers[i]]).T, color=colour, lw=0.5, zorder=2)
        _ellipse(axes, flowers[i], rows @ result.flowers.covs[i] @ rows.T, factor, colour, 0.18)
    for j in np.flatnonzero(result.clusters.n_flowers > 1):
        _ellipse(axes, middle[j], rows @ result.clusters.covs[j] @ rows.T, factor, PALETTE[colours[j]], 0.5)
    axes.scatter(flowers[:, 0], flowers[:, 1], s=4, c=[PALETTE[colours[j]] for j in where], linewidths=0, zorder=3)
    if len(result.clusters) <= _MANY:
        for j in np.flatnonzero(result.clusters.n_flowers > 1):
            above = (middle[j][0], max(flowers[where == j][:, 1].max(), middle[j][1]))
            axes.annotate(
                str(result.clusters.ids[j]),
                above,
                (0, 5),
                textcoords="offset points",
                ha="center",
                color=_INK,
                zorder=4,
            )
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1)


def _ellipse(axes: Axes, at: Array, cov: Array, factor: int, colour: str, alpha: float) -> None:
    """The outline of a 95 % ellipsoid, whose projection is the ellipse of the projected covariance."""
    from matplotlib.patches import Ellipse

    values, vectors = np.linalg.eigh(cov)
    width, height = 2 * factor * np.sqrt(chi2_threshold(3, 0.95) * np.maximum(values, 0.0))
    turn = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(Ellipse((at[0], at[1]), width, height, angle=turn, fc=colour, alpha=alpha, ec="none", zorder=1))


def draw_trajectory(result: Result) -> Figure | None:
    """The camera's path before and after, and how much was corrected over time (where the given poses are known)."""
    if result.session.n_frames < 2 or not len(result.flowers):
        return None
    given, after = result.session.T_world_camera, result.T_world_camera
    if np.allclose(given, after, atol=1e-7):
        figure, (path,) = _figure(1, 1, 3.0)
        _path(path, result, ((after, PALETTE[0], "estimated"),))
        return figure
    figure, (path, shift, turn) = _figure(1, 3, 2.3)
    _path(path, result, ((after, PALETTE[0], "estimated"), (given, PALETTE[1], "given")))
    moved = (np.swapaxes(given[:, :3, :3], -1, -2) @ (after[:, :3, 3] - given[:, :3, 3])[..., None])[..., 0]
    factor, unit = (1.0, "m") if np.abs(moved).max() > 0.1 else (1e3, "mm")
    turned = np.degrees(so3_log(np.swapaxes(given[:, :3, :3], -1, -2) @ after[:, :3, :3]))
    for axes, values in ((shift, factor * moved), (turn, turned)):
        for k, name in enumerate(("right", "down", "forward")):
            axes.plot(_seconds(result), values[:, k], color=PALETTE[k], lw=0.7, label=name)
    shift.set(xlabel="time (s)", ylabel=unit, title="shift, along the camera's axes")
    turn.set(xlabel="time (s)", ylabel="degrees", title="turn, about the camera's axes")
    turn.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _path(axes: Axes, result: Result, paths: tuple[tuple[Array, str, str], ...]) -> None:
    rows = _axes(result)[[0, 2]]
    origin = result.T_world_camera[0, :3, 3]
    for k, (poses, colour, label) in enumerate(paths):
        axes.plot(*((poses[:, :3, 3] - origin) @ rows.T).T, color=colour, lw=1.0 - 0.5 * k, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="to the right (m)", ylabel="up (m)", title="camera path")
    axes.legend(loc="best")


def draw_misfit(result: Result) -> Figure | None:
    """NIS over time with its band, and the share of errors inside the regions that should hold them."""
    curve = misfit_curve(result)
    if not len(curve.mean):
        return None
    figure, (left, right) = _figure(1, 2, 2.4, widths=(2.2, 1.0))
    left.fill_between(curve.times, curve.low / 3, curve.high / 3, color=_BAND, lw=0, label="95 % of means, if true")
    left.axhline(1.0, color=_SOFT, lw=0.7, ls="--")
    left.plot(curve.times, curve.mean / 3, color=PALETTE[0], lw=0.8, marker=".", ms=2, label="mean NIS / 3")
    left.set(xlabel="time (s)", ylabel="NIS / degrees of freedom")
    left.set_ylim(0, max(1.6, float(np.quantile(curve.mean, 0.98)) / 3 * 1.2))
    left.legend(loc="lower right")
    right.plot([0, 1], [0, 1], color=_SOFT, lw=0.7, ls="--")
    for k, one in enumerate(coverage_curves(result, None)):
        right.fill_between(one.nominal, one.low, one.high, color=_BAND, lw=0)
        right.plot(one.nominal, one.actual, color=PALETTE[k], marker=".", ms=3, lw=0.8, label=one.name)
    right.legend(loc="lower right", fontsize=6)
    right.set(xlabel="nominal probability", ylabel="share inside", xlim=(0, 1), ylim=(0, 1))
    right.set_aspect("equal")
    return figure


def draw_sway(result: Result) -> Figure | None:
    """Distance from rest over time of the clusters that moved most."""
    moved = sway(result)
    chosen = [int(j) for j in np.argsort(-moved.largest, kind="stable")[:_MOVERS] if moved.largest[j] > 0]
    if not chosen:
        return None
    known = np.isin(result.drift.cluster_ids, result.clusters.ids)
    seconds, distance = _seconds(result)[result.drift.frame[known]], np.linalg.norm(moved.displacement, axis=-1)
    figure, rows = _figure(len(chosen), 1, 0.4 + 1.0 * len(chosen))
    for axes, j in zip(rows, chosen, strict=True):
        mine = np.flatnonzero(moved.cluster == j)
        mine = mine[np.argsort(seconds[mine], kind="stable")]
        chance = 1e3 * np.sqrt(chi2_threshold(3, 0.95)) * moved.sigma[mine]
        axes.fill_between(seconds[mine], 0, chance, color=_BAND, lw=0, label="95 % of chance")
        axes.plot(seconds[mine], 1e3 * distance[mine], color=PALETTE[0], lw=0.8)
        axes.set_ylabel("mm")
        axes.set_title(f"cluster {result.clusters.ids[j]}: up to {length(moved.largest[j])} from rest", loc="left")
        axes.set_xlim(0, _seconds(result)[-1])
    rows[-1].set_xlabel("time (s)")
    rows[0].legend(loc="upper right")
    return figure


def draw_timeline(result: Result) -> Figure | None:
    """When each cluster was seen, and how many detections were rejected."""
    n_frames, n_clusters = result.session.n_frames, len(result.clusters)
    if n_frames < 2 or not n_clusters:
        return None
    seconds, frame = _seconds(result), result.session.observations.frame
    height = float(np.clip(0.12 * n_clusters, 0.8, 6.0))
    figure, (seen, lost) = _figure(2, 1, height + 1.3, ratios=(height, 0.8))
    colours = colour_indices(result.clusters.positions)
    for row, cluster in enumerate(result.clusters.ids):
        spans = _spans(np.unique(frame[result.cluster_ids == cluster]), seconds)
        seen.broken_barh(spans, (row - 0.35, 0.7), facecolor=PALETTE[colours[row]], lw=0)
    shown = np.arange(0, n_clusters, max(1, n_clusters // 25))
    seen.set_yticks(shown, [str(i) for i in result.clusters.ids[shown]])
    seen.set(ylabel="cluster", ylim=(n_clusters - 0.5, -0.5), xlim=(0, seconds[-1]))
    seen.grid(visible=False)
    rejected = np.bincount(frame[result.flower_ids == CLUTTER], minlength=n_frames)
    lost.plot(seconds, rejected, color=_SOFT, lw=0.7, drawstyle="steps-mid")
    lost.set(xlabel="time (s)", ylabel="rejected\nper frame", xlim=(0, seconds[-1]))
    lost.set_ylim(bottom=0)
    return figure


def _spans(frames: IntArray, seconds: Array) -> list[tuple[float, float]]:
    """Start and length of each run of consecutive frames; a frame lasts until the next."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1) if len(frames) else []
    ends = np.append(seconds[1:], seconds[-1])
    return [(float(seconds[run[0]]), float(ends[run[-1]] - seconds[run[0]])) for run in runs]


def _seconds(result: Result) -> Array:
    seconds: Array = result.session.stamps - result.session.stamps[0]
    return seconds


def _figure(
    n_rows: int,
    n_columns: int,
    height: float,
    *,
    ratios: tuple[float, float] | None = None,
    widths: tuple[float, float] | None = None,
) -> tuple[Figure, list[Axes]]:
    """A figure without pyplot's global state, laid out so that nothing overlaps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    grid = {"height_ratios": ratios, "width_ratios": widths}
    axes = figure.subplots(
        n_rows, n_columns, squeeze=False, gridspec_kw={k: v for k, v in grid.items() if v is not None}
    )
    return figure, list(axes.ravel())
