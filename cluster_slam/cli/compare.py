"""``cluster-slam compare-descriptors``: which descriptor tells clusters apart."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption, SeedOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table
from cluster_slam.errors import InputError


def command(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for tables, a figure and a page.")],
    recordings: Annotated[
        Path | None,
        typer.Option(
            "--recordings", metavar="FOLDER", help="Sessions strawberryN-labels, -strict.", show_default=False
        ),
    ] = None,
    seed: SeedOption = 0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare descriptors of clusters.

    False matches, rank 1, coverage and cost over noise, count, radius, missing and new flowers, beside what no
    descriptor can beat. Takes about two minutes.

    Example: cluster-slam compare-descriptors -o out/compare
    """
    from cluster_slam.compare import compare_descriptors
    from cluster_slam.compare.comparison_page import case_words
    from cluster_slam.compare.contenders import DEFAULT, PAPER

    if recordings is not None and not recordings.is_dir():
        raise InputError(f"{recordings}: missing, expected a folder of recordings")
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        done = compare_descriptors(out, seed=seed, recordings=recordings, progress=progress)
    rates = {(o.case, o.name): o.false_match_rate for o in done.outcomes}
    if as_json:
        rows = [{"case": case_words(c), "descriptor": n, "false_match_rate": r} for (c, n), r in rates.items()]
        print_json({"out": str(out), "false_match_rates": rows})
    elif not quiet:
        words = {c: f"{rates[c, DEFAULT]:.2%} (the paper's {rates[c, PAPER]:.2%})" for c, n in rates if n == PAPER}
        table = [(case_words(c), text) for c, text in words.items()]
        print_table("false matches at 95 % recall", [*table, ("page", str(out / "index.html"))])
