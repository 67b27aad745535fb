"""The evaluation of Chu et al., "Robust flower cluster matching using the unscented transform", run again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from cluster_slam.errors import OutputError
from cluster_slam.io.folder import check_writable, recover, write_folder
from cluster_slam.reproduce import page
from cluster_slam.reproduce.figures import figure_files
from cluster_slam.reproduce.paper_page import Reproduction, percent_text, render
from cluster_slam.reproduce.settings import PAPER_TABLE_2, Settings
from cluster_slam.reproduce.table1 import table1
from cluster_slam.reproduce.table2 import table2
from cluster_slam.reproduce.table3 import own_frame_matches, recordings, table3

MARKER = "reproduction.json"  # a folder that holds it may be replaced
Progress = Callable[[str, float], None]


def reproduce_paper(
    out: Path,
    *,
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    noise: float = 0.01,
    scale: float = 1.0,
    progress: Progress | None = None,
) -> Reproduction:
    """Tables I to III and figures 2 to 8 into a folder: `index.html`, three CSV tables, PNG pictures.

    Parameters
    ----------
    out
        Absent, empty, or an earlier reproduction, which is replaced whole.
    alpha, beta, kappa
        Of the unscented transform; the defaults are those that give table I.
    noise
        Lowest noise level of table I and noise of tables II and III, m.
    scale
        Side of the cube that simulated flowers are drawn in, m.
    progress
        Called with a stage in words and the fraction done.

    Raises
    ------
    ConfigError
        A parameter is out of its range.
    OutputError
        `out` holds something else or cannot be written.
    """
    say = progress or (lambda stage, fraction: None)
    settings = Settings(alpha, beta, kappa, noise, scale)
    check_replaceable(out, MARKER)
    say("table I", 0.0)
    noise_rows = table1(settings)
    say("table II", 0.05)
    match_rows = table2(settings)
    say("table III", 0.6)
    data = recordings()
    recording_rows, own = table3(settings, data), own_frame_matches(settings, data[0])
    done = Reproduction(settings, noise_rows, match_rows, recording_rows, own, out)
    say("figures", 0.75)
    pictures = figure_files(settings, noise_rows, data)
    write_folder(out, {**_tables(done), **pictures, "index.html": render(done, pictures), MARKER: _record(done)})
    say("done", 1.0)
    return done


def check_replaceable(out: Path, marker: str) -> None:
    """Refuse a folder that holds something else than an earlier output of the same kind.

    Raises
    ------
    OutputError
        Names the folder and what is there.
    """
    check_writable(out)
    recover(out)
    if out.is_dir() and any(out.iterdir()) and not (out / marker).exists():
        first = sorted(path.name for path in out.iterdir())[0]
        raise OutputError(f"{out}: holds something else ({first}); give an empty or a new folder")


def _tables(done: Reproduction) -> dict[str, str]:
    one = [(f"{row.noise:g}", f"{row.frobenius_norm:.4e}", f"{row.outlier_percent:.2f}") for row in done.table1]
    two = [
        (
            row.reading,
            row.padding,
            row.correct_match,
            f"{row.false_positive_avg:.4f}",
            *PAPER_TABLE_2[row.padding != "none"],
        )
        for row in done.table2
    ]
    two_header = (
        "reading",
        "padding",
        "correct_match",
        "false_positive_avg",
        "paper_correct",
        "paper_false_positive_avg",
    )
    three = [(r.comparison, r.match, r.n_frames, r.paper_match, percent_text(r)) for r in done.table3]
    three_header = ("comparison", "match", "n_frames", "paper_match", "other_clusters_percent")
    return {
        "table1.csv": page.csv_text(("noise", "frobenius_norm", "outlier_percent"), one),
        "table2.csv": page.csv_text(two_header, two),
        "table3.csv": page.csv_text(three_header, three),
    }


def _record(done: Reproduction) -> str:
    """Options and numbers for other programs."""
    content = {"settings": asdict(done.settings), "is_table1_exact": done.is_table1_exact}
    return json.dumps(content, indent=2) + "\n"
