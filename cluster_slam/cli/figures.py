"""``cluster-slam figures``: pictures of a result that could go into a paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.summary import print_json, print_table, print_warnings
from cluster_slam.errors import OutputError


def command(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder.", show_default=False)],
    session: Annotated[
        Path | None,
        typer.Argument(metavar="SESSION", help="Its session; default: where it was.", show_default=False),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for the figures.")] = Path("figures"),
    formats: Annotated[str, typer.Option("--formats", metavar="LIST", help="Of png, svg and pdf.")] = "png,svg",
    dpi: Annotated[int, typer.Option("--dpi", min=50, max=1200, help="Pixels an inch of png.")] = 300,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Draw the figures of a result for a paper.

    Map, trajectory, misfit, sway and timeline, each where the result has data for it.

    Example: cluster-slam figures out/demo -o out/figures
    """
    from cluster_slam.io.folder import check_writable
    from cluster_slam.io.run_record import read_run
    from cluster_slam.io.session import OBSERVED, open_session
    from cluster_slam.report.figures import write_figures
    from cluster_slam.report.folder import open_result

    if out.resolve().is_relative_to(result.resolve()):
        raise OutputError(f"{out}: inside of the result, which is replaced as a whole, expected a folder elsewhere")
    check_writable(out)
    run = read_run(result / "run.json")
    folder = session or (run.session_path if run.session_path and run.session_path.is_dir() else None)
    opened = None if folder is None else open_session(folder, level=run.level, observed=result / OBSERVED)
    if opened is None and not quiet:
        print_warnings([f"{result}: its session {run.session_path} is not there, so figures lack what only it knows"])
    paths = write_figures(open_result(result, opened), out, formats=formats.replace(" ", "").split(","), dpi=dpi)
    if as_json:
        print_json({"figures": [str(path) for path in paths]})
    elif not quiet:
        print_table("cluster-slam figures", [(path.stem, str(path)) for path in paths])
    return 0
