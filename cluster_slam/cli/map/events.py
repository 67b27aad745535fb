"""``map event``: what was done to a cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.map.options import MapArgument, opened, print_columns, tell
from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.summary import print_json
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.io.map.ledger import Event


def event(
    path: MapArgument,
    cluster: Annotated[
        int | None, typer.Argument(metavar="CLUSTER", help="Its id in the map.", show_default=False)
    ] = None,
    kind: Annotated[
        str | None, typer.Argument(metavar="KIND", help="pollinated, harvested, note, ...", show_default=False)
    ] = None,
    time: Annotated[
        str | None, typer.Option("--time", metavar="ISO", help="When; default: now.", show_default=False)
    ] = None,
    note: Annotated[str, typer.Option("--note", help="A remark.")] = "",
    delete: Annotated[
        int | None, typer.Option("--delete", metavar="EVENT", help="Take this event out.", show_default=False)
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Record an event against a cluster; it stays with the cluster through all sessions.

    With only a MAP all events are listed, with a CLUSTER its own.

    Example: cluster-slam map event field.map 17 pollinated --time 2026-05-04T10:30 --note "brush, second pass"
    """
    from time import time as clock

    from cluster_slam.io.map.ledger import delete_event, events, record
    from cluster_slam.io.map.times import seconds

    title = "cluster-slam map event"
    if delete is not None and (cluster is not None or kind is not None):
        raise ConfigError(f"--delete {delete} takes out an event by its own id, expected no CLUSTER and no KIND")
    with opened(path) as store:
        if delete is not None:
            delete_event(store, delete)
            tell(title, {"deleted": delete}, [("deleted", str(delete))], quiet=quiet, as_json=as_json)
            return 0
        if cluster is None or kind is None:
            return _list(events(store, cluster), quiet=quiet, as_json=as_json)
        done = record(store, cluster, kind, clock() if time is None else seconds(time), note)
    return _list([done], quiet=quiet, as_json=as_json, one=True)


def _list(found: list[Event], *, quiet: bool, as_json: bool, one: bool = False) -> int:
    from cluster_slam.io.map.times import iso

    named = [{"event": e.id, "map_id": e.cluster, "kind": e.kind, "time": e.time, "note": e.note} for e in found]
    if as_json:
        print_json(named[0] if one else {"events": named})
    elif not quiet:
        rows = [(str(e.id), str(e.cluster), e.kind, iso(e.time), e.note) for e in found]
        title = "cluster-slam map event" if one else f"{len(found)} events"
        print_columns(title, ("event", "cluster", "kind", "time", "note"), rows)
    return 0
