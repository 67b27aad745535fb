"""One picture of a localised session: where the camera was in the map, and how sure that is over time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import PlantMap, SessionLocalisation

_LOST = "#c44e52"
_FOUND = "#4c72b0"
_MAP = "#8c8c8c"


def localisation_picture(found: SessionLocalisation, plants: Sequence[PlantMap]) -> bytes:
    """An SVG: the plant with most located frames and the camera's path from the two widest sides; error bars below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(3, 2))
    names = [n for n, here in zip(found.plants, found.is_located.tolist(), strict=True) if here]
    name = max(sorted(set(names)), key=names.count) if names else ""
    marks = next((p.flowers for p in plants if p.name == name), np.zeros((0, 3)))
    here = found.is_located & np.array([n == name for n in found.plants])
    _draw_places(parts[0], name, marks, found.T_map_camera[here, :3, 3])
    _draw_sureness(parts[1], found)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _draw_places(figure: Any, name: str, flowers: Array, path: Array) -> None:
    axes = figure.subplots(1, 2)
    for view, (a, b) in zip(axes, ((0, 2), (0, 1)), strict=True):
        view.scatter(flowers[:, a], flowers[:, b], s=6, color=_MAP, label="flowers of the map")
        view.scatter(path[:, a], path[:, b], s=4, color=_FOUND, label="camera")
        view.set_xlabel(f"{'xyz'[a]} (m)")
        view.set_ylabel(f"{'xyz'[b]} (m)")
        view.set_aspect("equal", adjustable="datalim")
        view.grid(alpha=0.3)
    axes[0].legend(fontsize="small")
    figure.suptitle(f"plant {name}" if name else "no frame was located")


def _draw_sureness(figure: Any, found: SessionLocalisation) -> None:
    t = found.session.stamps - found.session.stamps[0]
    here = found.is_located
    var = np.diagonal(found.covs, axis1=1, axis2=2)
    axes = figure.subplots()
    axes.plot(t[here], 1e3 * np.sqrt(var[here, 3:].sum(1)), ".", color=_FOUND, markersize=3)
    axes.set_ylabel("position, one sigma (mm)")
    axes.set_xlabel("time (s)")
    axes.plot(t[~here], np.zeros((~here).sum()), "|", color=_LOST, label="lost")
    if here.any():
        axes.set_yscale("symlog", linthresh=1.0)
    axes.set_ylim(bottom=-0.1)
    axes.grid(alpha=0.3)
    if (~here).any():
        axes.legend(fontsize="small")
