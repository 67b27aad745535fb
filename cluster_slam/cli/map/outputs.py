"""``map predict``, ``export`` and ``report``: files that are made of a map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cluster_slam.cli.map.options import MapArgument, PlantOption, opened, tell
from cluster_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption, configured
from cluster_slam.config import MapConfig


def predict(
    path: MapArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE.csv", help="Table to write.", show_default=False)],
    date: Annotated[str, typer.Option("--date", metavar="ISO", help="The date.", show_default=False)],
    config: ConfigOption = None,
    settings: SetOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Predict where each cluster will be on a date, with the covariance of its centroid.

    Example: cluster-slam map predict field.map --date 2026-05-11 -o monday.csv
    """
    from cluster_slam.io.map.export import predictions
    from cluster_slam.io.map.file import write_file
    from cluster_slam.io.map.times import iso, seconds
    from cluster_slam.remember.predict import predict_plant

    options = configured(MapConfig(), config, settings or [])
    when = seconds(date)
    with opened(path) as store:
        found = [predict_plant(plant, when, options) for plant in store.plants()]
    write_file(out, predictions([p for p, _ in found], [c for _, c in found]))
    n = sum(len(p.cluster_ids) for p, _ in found)
    rows = [("date", iso(when)), ("clusters", str(n)), ("table", str(out))]
    tell("cluster-slam map predict", {"out": str(out), "clusters": n}, rows, quiet=quiet, as_json=as_json)
    return 0


def export(
    path: MapArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder to write.", show_default=False)],
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Write clusters, flowers, sessions and events of a map as CSV, and a g2o graph.

    Example: cluster-slam map export field.map -o out/export
    """
    from cluster_slam.io.map.export import export_map

    with opened(path) as store:
        export_map(store, out)
    tell("cluster-slam map export", {"out": str(out)}, [("folder", str(out))], quiet=quiet, as_json=as_json)
    return 0


def report(
    path: MapArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE.html", help="Page to write.", show_default=False)],
    plant: PlantOption = None,
    truth: Annotated[
        list[Path] | None,
        typer.Option(
            "--truth",
            metavar="RESULT",
            help="A result that was added, of a session with truth; all of them.",
            show_default=False,
        ),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Write the season report: plants in 3-D by date, life lines, drift, events, each alignment before and after.

    With the results of all sessions as --truth (of sessions that have one) it says how good re-identification was.

    Example: cluster-slam map report field.map -o season.html
    """
    from cluster_slam.io.map.file import write_file
    from cluster_slam.report.season import render_season

    with opened(path) as store:
        write_file(out, render_season(store, plant, truth or ()))
    tell("cluster-slam map report", {"out": str(out)}, [("page", str(out))], quiet=quiet, as_json=as_json)
    return 0
