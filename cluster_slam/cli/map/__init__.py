"""``cluster-slam map``: a map that remembers plants over sessions."""

from __future__ import annotations

import typer

from cluster_slam.cli.map.add import add
from cluster_slam.cli.map.changes import create, merge, optimise, undo
from cluster_slam.cli.map.events import event
from cluster_slam.cli.map.match import match
from cluster_slam.cli.map.outputs import export, predict, report
from cluster_slam.cli.map.questions import check, list_clusters, show

app = typer.Typer(
    help="A map that knows clusters again over days: one file, made by `map create`, fed by `map add`.",
    rich_markup_mode=None,
    no_args_is_help=True,
)
app.command("create", short_help="Make an empty map.")(create)
app.command("add", short_help="Put a session into a map.")(add)
app.command("match", short_help="How well a result fits each plant; changes nothing in the map.")(match)
app.command("list", short_help="Clusters of a map that answer a question.")(list_clusters)
app.command("show", short_help="What is in a map.")(show)
app.command("undo", short_help="Take the latest session out again.")(undo)
app.command("merge", short_help="Take the plants of another map in.")(merge)
app.command("optimise", short_help="Smooth all sessions of each plant together.")(optimise)
app.command("event", short_help="Record what was done to a cluster.")(event)
app.command("predict", short_help="Where each cluster will be on a date.")(predict)
app.command("export", short_help="Write a map as plain tables.")(export)
app.command("report", short_help="A page with a slider over dates.")(report)
app.command("check", short_help="Is a map whole?")(check)
