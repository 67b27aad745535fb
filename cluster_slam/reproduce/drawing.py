"""What all figures of the reproduction and the comparison share: size, type, colours, and PNG bytes that repeat."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from cluster_slam.geometry import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito (2008), told apart with all common kinds of colour blindness
BLUE, RED, GREEN, PINK, SKY, OCHRE, GREY = "#0072b2", "#d55e00", "#00855f", "#b85f92", "#3596d1", "#b97700", "#777777"
COLOURS = (BLUE, RED, GREEN, PINK, SKY, OCHRE)
DPI = 160
_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.04,
    "svg.hashsalt": "cluster-slam",
}


@contextmanager
def style() -> Iterator[None]:
    """Draw within it."""
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def new_figure(width: float, height: float) -> Figure:
    """An empty figure, inches; not known to pyplot, so that nothing is kept."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def as_bytes(figure: Figure, kind: str = "png") -> bytes:
    """The figure as PNG or SVG, the same bytes each time."""
    buffer = io.BytesIO()
    metadata = {"Software": None} if kind == "png" else {"Date": None}
    figure.savefig(buffer, format=kind, dpi=DPI, metadata=metadata)
    return buffer.getvalue()


def draw_flowers(axes: Any, points: Array, colour: str, label: str | None = None, size: float = 26.0) -> None:
    """A cluster (n, 3) in 3-D axes, in centimetres, each flower joined to the centroid."""
    p = 100.0 * points
    c = p.mean(0)
    axes.scatter(*p.T, s=size, color=colour, label=label, depthshade=False)
    axes.scatter(*c, marker="+", s=50, color=colour)
    for flower in p:
        axes.plot(*np.stack([c, flower]).T, color=colour, lw=0.7)


def equal_box(axes: Any, points: Array) -> None:
    """Equal scales on all three axes of a 3-D plot of points (n, 3), m."""
    p = 100.0 * points
    centre, half = (p.min(0) + p.max(0)) / 2, 0.55 * float(np.ptp(p, axis=0).max())
    for axis, c in zip("xyz", centre, strict=True):
        getattr(axes, f"set_{axis}lim")(c - half, c + half)
        getattr(axes, f"set_{axis}label")(f"{axis} [cm]", labelpad=-6)
    axes.set_box_aspect((1, 1, 1))
    axes.tick_params(labelsize=6, pad=-2)


def ellipse(mean: Array, cov: Array, threshold: float, n: int = 181) -> Array:
    """Points (n, 2) on the border of a two-dimensional gate."""
    angle = np.linspace(0.0, 2.0 * np.pi, n)
    circle = np.sqrt(threshold) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    out: Array = mean + circle @ np.linalg.cholesky(cov).T
    return out
