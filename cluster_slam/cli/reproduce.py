"""``cluster-slam reproduce paper``: the paper's tables and figures, run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings

app = typer.Typer(help="Run a published evaluation again.")


@app.callback()
def _group() -> None:
    """Keeps ``paper`` a command of its own while it is the only one."""


@app.command("paper")
def paper(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for tables, figures and a page.")],
    alpha: Annotated[float, typer.Option("--alpha", help="Spread of the sigma points.")] = 1.0,
    beta: Annotated[float, typer.Option("--beta", help="Weight of the centre in the covariance.")] = 2.0,
    kappa: Annotated[float, typer.Option("--kappa", help="Second scaling of the sigma points.")] = 0.0,
    noise: Annotated[float, typer.Option("--noise", help="Lowest noise of the flowers, m.")] = 0.01,
    scale: Annotated[float, typer.Option("--scale", help="Side of the cube with the flowers, m.")] = 1.0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Recompute the paper's tables and figures.

    Tables I to III and figures 2 to 8, beside what the paper prints; what does not reproduce is said.

    Example: cluster-slam reproduce paper -o out/paper
    """
    from cluster_slam.reproduce.paper import reproduce_paper

    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        done = reproduce_paper(out, alpha=alpha, beta=beta, kappa=kappa, noise=noise, scale=scale, progress=progress)
    is_off = done.settings.is_paper and not done.is_table1_exact
    if as_json:
        print_json({"out": str(out), "is_table1_exact": done.is_table1_exact})
    elif not quiet:
        words = "as printed, to the digit" if done.is_table1_exact else "not as printed"
        print_table("cluster-slam reproduce paper", [("table I", words), ("page", str(out / "index.html"))])
    if is_off:
        print_warnings(["table I is not as printed: NumPy or SciPy draw or sum differently on this machine"])
    return 1 if is_off else 0
