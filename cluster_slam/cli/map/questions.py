"""``map list``, ``show`` and ``check``: what is in a map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.map.options import MapArgument, opened, print_columns
from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.summary import print_json, print_warnings

if TYPE_CHECKING:
    from cluster_slam.io.map.ledger import Event
    from cluster_slam.io.map.store import StoredSession
    from cluster_slam.records import PlantMap


def list_clusters(
    path: MapArgument,
    where: Annotated[
        str | None,
        typer.Option("--where", metavar="CONDITIONS", help="Conditions joined by 'and'.", show_default=False),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """List clusters, all or those for which all conditions hold.

    Conditions compare map_id, plant, x, y, z, n_flowers, presence, state, last_seen, last_looked_at, or ask for events.

    Example: cluster-slam map list field.map --where "n_flowers >= 3 and not pollinated since monday"
    """
    from dataclasses import asdict

    from cluster_slam.io.map.ledger import ask
    from cluster_slam.io.map.times import minutes

    with opened(path) as store:
        rows = ask(store, where)
    if as_json:
        none = {"last_seen": None, "last_looked_at": None}
        clusters = [{k: none.get(k) if v != v else v for k, v in asdict(row).items()} for row in rows]
        print_json({"clusters": clusters})
    elif not quiet:
        several = len({row.plant for row in rows}) > 1
        header = ("cluster", *(("plant",) if several else ()), "flowers", "x y z (m)", "state", "last seen, UTC")
        shown = [
            (
                *(str(row.map_id), *((row.plant,) if several else ()), str(row.n_flowers)),
                *(f"{row.x:.3f} {row.y:.3f} {row.z:.3f}", f"{row.state} {row.presence:.2f}", minutes(row.last_seen)),
            )
            for row in rows
        ]
        print_columns(f"{len(rows)} clusters", header, shown)
    return 0


def show(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Show plants, sessions, clusters, flowers and events of a map.

    Example: cluster-slam map show field.map
    """
    from cluster_slam.io.map.ledger import events

    with opened(path) as store:
        plants, sessions, ledger = store.plants(), store.sessions(), events(store)
    if as_json:
        counted = [{"name": p.name, "clusters": len(p.cluster_ids), "flowers": len(p.flower_ids)} for p in plants]
        listed = [{"id": s.session, "plant": s.plant, "probability": s.probability} for s in sessions]
        print_json({"plants": counted, "sessions": listed, "events": len(ledger)})
    elif not quiet:
        print_columns(f"{path}: {len(plants)} plants, {len(sessions)} sessions, {len(ledger)} events", (), ())
        _show_plants(plants, sessions, ledger)
        _show_sessions(sessions)
    return 0


def _show_plants(plants: list[PlantMap], sessions: list[StoredSession], ledger: list[Event]) -> None:
    rows = []
    for p in plants:
        ids = set(p.cluster_ids.tolist())
        alive, n_events = int((p.flower_presence > 0.5).sum()), sum(e.cluster in ids for e in ledger)
        n_sessions = sum(s.plant == p.name for s in sessions)
        gone, drift = str(len(p.flower_ids) - alive), f"{1e3 * p.drift_rate:.1f}"
        rows.append((p.name, str(n_sessions), str(len(ids)), str(alive), gone, drift, str(n_events)))
    header = ("plant", "sessions", "clusters", "flowers", "gone", "mm a day", "events")
    if rows:
        print_columns("plants", header, rows)


def _show_sessions(sessions: list[StoredSession]) -> None:
    from cluster_slam.io.map.times import minutes

    header = ("session", "plant", "start", "alignment")
    rows = []
    for s in sessions:
        aligned = "makes the frame" if s.evidence != s.evidence else f"sure to {s.probability:.4f}"
        rows.append((s.session, s.plant, minutes(s.start), aligned))
    if rows:
        print_columns("sessions", header, rows)


def check(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Check that a map is whole: the file, what refers to what, all numbers. Exit code 1 and the reasons if it is not.

    Example: cluster-slam map check field.map
    """
    from cluster_slam.io.map.check import problems

    with opened(path) as store:
        found = problems(store)
        n = len(store.sessions()) if not found else 0
    if as_json:
        print_json({"whole": not found, "problems": found})
    elif not quiet and not found:
        print_columns("cluster-slam map check", (), [("map", str(path)), ("verdict", f"whole, {n} sessions")])
    if found:
        print_warnings(found)
    return 1 if found else 0
