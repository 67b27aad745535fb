"""Figures of a result for a paper: vector and pixel graphics, the same bytes for the same result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cluster_slam.errors import OutputError
from cluster_slam.records import Result
from cluster_slam.report import drawings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "svg", "pdf")
_STYLE: Any = {
    "font.family": "DejaVu Sans",  # ships with matplotlib: the same on every machine
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.03,
    "svg.hashsalt": "cluster-slam",
    "svg.fonttype": "path",
}


@dataclass(frozen=True, slots=True)
class FigureKind:
    """A figure by its file name."""

    name: str
    draw: Callable[[Result], Figure | None]  # None where the result has nothing to show


KINDS = (
    FigureKind("map", drawings.draw_map),
    FigureKind("trajectory", drawings.draw_trajectory),
    FigureKind("misfit", drawings.draw_misfit),
    FigureKind("sway", drawings.draw_sway),
    FigureKind("timeline", drawings.draw_timeline),
)


def write_figures(
    result: Result, out: Path, *, formats: Sequence[str] = ("png", "svg"), dpi: int = 300
) -> tuple[Path, ...]:
    """Write all figures of a result into a folder.

    Parameters
    ----------
    result : Result
        From memory, or read back by ``cluster_slam.report.folder.open_result``.
    out : Path
        Folder; made where it is absent. Figures of the same names are replaced.
    formats : sequence of str
        Of ``png``, ``svg``, ``pdf``.
    dpi : int
        Pixels an inch of ``png``; figures are 7 inches wide, two columns of most journals.

    Returns
    -------
    tuple of Path
        The files, in the order drawn. A figure that the result has no data for is left out.

    Raises
    ------
    OutputError
        An unknown format, or the folder cannot be written.
    """
    from matplotlib import rc_context

    unknown = sorted(set(formats) - set(FORMATS))
    if unknown:
        raise OutputError(f"unknown format {unknown[0]!r}, expected one of {', '.join(FORMATS)}")
    written: list[Path] = []
    with rc_context(_STYLE):
        for kind in KINDS:
            for suffix in formats:  # drawn anew for each: saving a figure moves its axes a little
                figure = kind.draw(result)
                if figure is not None:
                    written.append(_save(figure, out / f"{kind.name}.{suffix}", dpi))
    return tuple(written)


def _save(figure: Figure, path: Path, dpi: int) -> Path:
    metadata = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[path.suffix[1:]]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=dpi if path.suffix == ".png" else 72, metadata=metadata)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from None
    return path
