"""``cluster-slam figures``: pictures of a result that could go into a paper."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.summary import print_json, print_table
from cluster_slam.errors import InputError, OutputError


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
    """Draw the figures of a result: map, trajectory, misfit, sway, timeline.

    Example: cluster-slam figures out/demo -o out/figures
    """
    from cluster_slam.io.folder import check_writable
    from cluster_slam.io.read_result import read_origin, read_result
    from cluster_slam.io.session import open_session
    from cluster_slam.report.figures import write_figures

    if out.resolve().is_relative_to(result.resolve()):
        raise OutputError(f"{out}: inside of the result, which is replaced as a whole, expected a folder elsewhere")
    check_writable(out)
    origin = read_origin(result)
    folder = session or origin.session
    if folder is None or not folder.is_dir():
        raise InputError(f"{result / 'run.json'}: its session {folder} is missing, expected SESSION after RESULT")
    made = read_result(result, open_session(folder, level=origin.level))
    paths = write_figures(made, out, formats=formats.replace(" ", "").split(","), dpi=dpi)
    if as_json:
        print_json({"figures": [str(path) for path in paths]})
    elif not quiet:
        print_table("cluster-slam figures", [(path.stem, str(path)) for path in paths])
    return 0
