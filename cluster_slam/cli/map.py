"""``cluster-slam map``: a map that remembers plants over sessions."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption, configured
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings
from cluster_slam.config import MapConfig
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.io.map.incoming import Incoming
    from cluster_slam.io.map.store import MapStore, StoredSession
    from cluster_slam.pipeline.remember import Added
    from cluster_slam.remember.decide import Decision

app = typer.Typer(
    help="A map that knows clusters again over days: one file, made by `map create`, fed by `map add`.",
    rich_markup_mode=None,
    no_args_is_help=True,
)
MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="The map: one file.", show_default=False)]
ResultArgument = Annotated[Path | None, typer.Argument(metavar="[RESULT]", help="Result folder.", show_default=False)]
AlignOption = Annotated[
    str, typer.Option("--align", metavar="KIND", help="rigid, or similarity: a scale of 0.9 to 1.1 as well.")
]


@app.command("create", short_help="Make an empty map.")
def create(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Make an empty map.

    Example: cluster-slam map create field.map
    """
    from cluster_slam.io.map import create_map

    create_map(path).close()
    if as_json:
        print_json({"map": str(path)})
    elif not quiet:
        print_table("cluster-slam map create", [("map", str(path))])
    return 0


@app.command("add", short_help="Put a session into a map.")
def add(
    path: MapArgument,
    result: ResultArgument = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(
            "--landmarks", metavar="FILE", help="flower_id,cluster_id,x,y,z instead of a RESULT.", show_default=False
        ),
    ] = None,
    plant: Annotated[
        str | None, typer.Option("--plant", metavar="NAME", help="The plant's name.", show_default=False)
    ] = None,
    new_plant: Annotated[bool, typer.Option("--new-plant", help="What fits no plant founds a new one.")] = False,
    any_plant: Annotated[bool, typer.Option("--any-plant", help="Try all plants, whatever the session says.")] = False,
    align: AlignOption = "rigid",
    date: Annotated[
        str | None, typer.Option("--date", metavar="ISO", help="When landmarks stood there.", show_default=False)
    ] = None,
    session: Annotated[
        str | None, typer.Option("--session", metavar="ID", help="Id of landmarks' session.", show_default=False)
    ] = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Align a session with the map, say who is who, and store it, all or nothing.

    RESULT (as smooth or track made it) gets identities.csv, flower_identities.csv and the alignment in run.json. A
    session whose plant the map knows must align with it; one without a name is tried on all plants.

    Example: cluster-slam map add field.map out/monday
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.complete import check_result, complete_result, replace_files
    from cluster_slam.pipeline.remember import add as add_session

    options = configured(MapConfig(), config, settings or [])
    similarity = _is_similarity(align)
    started = perf_counter()
    with open_map(path) as store, StageProgress(is_shown=not (quiet or as_json)) as progress:
        incoming = _incoming(result, landmarks, date, session)
        if result is not None:
            check_result(result)
        left = _left_incomplete(store, incoming, result)
        if left is not None and result is not None:
            complete_result(result, store, left)
            return _tell_completed(left, quiet=quiet, as_json=as_json)
        added = add_session(
            store,
            incoming,
            plant=plant,
            new_plant=new_plant,
            any_plant=any_plant,
            similarity=similarity,
            config=options,
            progress=progress,
        )
        if added.session is not None and result is not None:
            complete_result(result, store, added.session)
        elif result is not None:
            replace_files(result, {}, {"aligned": False})
    if as_json:
        print_json(_added_json(added))
    elif not quiet:
        print_warnings(incoming.warnings)
        _tell_added(added, incoming, perf_counter() - started)
    if added.session is None:
        print_warnings([f"refused, the map is unchanged: {added.decision.reason}"])
    return 0 if added.session is not None else 1


def _left_incomplete(store: MapStore, incoming: Incoming, result: Path | None) -> StoredSession | None:
    """The session in the map, if just this result of it was added and the program then killed before it said so."""
    from cluster_slam.io.map.complete import is_complete

    if result is None or is_complete(result):
        return None
    same = [s for s in store.sessions() if s.session == incoming.constellation.session]
    return same[0] if same and same[0].digest == incoming.digest else None


def _tell_completed(session: StoredSession, *, quiet: bool, as_json: bool) -> int:
    if as_json:
        print_json({"aligned": True, "plant": session.plant, "session": session.session, "was_in_map": True})
    elif not quiet:
        rows = [("session", f"{session.session} is in the map already; its result is complete now")]
        print_table("cluster-slam map add", rows)
    return 0


def _is_similarity(align: str) -> bool:
    if align not in ("rigid", "similarity"):
        raise ConfigError(f"--align {align!r}, expected rigid or similarity")
    return align == "similarity"


def _incoming(result: Path | None, landmarks: Path | None, date: str | None, session: str | None) -> Incoming:
    from cluster_slam.io.map.incoming import read_incoming, read_landmarks
    from cluster_slam.io.map.times import seconds

    if result is not None and landmarks is None:
        if date is not None or session is not None:
            raise ConfigError("--date and --session go with --landmarks: a result has its own")
        return read_incoming(result)
    if landmarks is not None and result is None:
        return read_landmarks(landmarks, time=None if date is None else seconds(date), session=session)
    raise ConfigError("expected either a RESULT folder or --landmarks FILE")


def _added_json(added: Added) -> dict[str, object]:
    if added.session is None:
        return {"aligned": False, "reason": added.decision.reason, "refusal": added.decision.refusal.value}
    from cluster_slam.geometry import tum_from_pose

    return {
        "aligned": True,
        "plant": added.session.plant,
        "session": added.session.session,
        "probability": added.session.probability,
        "T_map_world": tum_from_pose(added.session.T_map_world).tolist(),
        "clusters": {"known": added.n_known, "new": added.n_new, "missed": added.n_missed},
        "flowers": {"known": added.n_flowers_known, "new": added.n_flowers_new},
    }


def _tell_added(added: Added, incoming: Incoming, seconds: float) -> None:
    if added.session is None:
        return
    rows = [
        ("session", added.session.session),
        ("plant", added.session.plant),
        ("alignment", _alignment(added)),
        ("clusters", f"{added.n_known} known again, {added.n_new} new, {added.n_missed} looked at and not seen"),
        ("flowers", f"{added.n_flowers_known} known again, {added.n_flowers_new} new"),
        ("time", f"{seconds:.1f} s"),
    ]
    print_table("cluster-slam map add", rows)


def _alignment(added: Added) -> str:
    if not added.decision.matches or added.decision.accepted is None or added.session is None:
        return "the first session of a plant makes its frame"
    import numpy as np

    sigma = np.sqrt(np.diag(added.session.cov))
    turn, shift = np.degrees(sigma[:3].max()), 1e3 * sigma[3:].max()
    return f"sure to {added.session.probability:.4f}; one sigma {turn:.2f} deg, {shift:.1f} mm"


@app.command("match", short_help="How well a result fits each plant; changes nothing in the map.")
def match(
    path: MapArgument,
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder.", show_default=False)],
    align: AlignOption = "rigid",
    config: ConfigOption = None,
    settings: SetOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Rank all plants of a map by how well a result fits them; writes matches.csv into the result.

    Example: cluster-slam map match field.map out/unknown
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.complete import check_result, replace_files
    from cluster_slam.io.map.export import table
    from cluster_slam.io.map.incoming import read_incoming
    from cluster_slam.pipeline.remember import match_all

    options = configured(MapConfig(), config, settings or [])
    with open_map(path) as store, StageProgress(is_shown=not (quiet or as_json)) as progress:
        incoming = read_incoming(result)
        check_result(result)
        decision = match_all(store, incoming, similarity=_is_similarity(align), config=options, progress=progress)
    rows = _match_rows(decision)
    header = ["plant", "log_likelihood_ratio", "probability", "accepted", "evidence"]
    replace_files(result, {"matches.csv": table(header, rows)}, {})
    if as_json:
        named = [dict(zip(header, row, strict=True)) for row in rows]
        print_json({"matches": named, "refusal": decision.refusal.value, "reason": decision.reason})
    elif not quiet:
        shown = [(row[0], f"log likelihood ratio {row[1]}, probability {row[2]}, {row[3]}") for row in rows[:10]]
        print_table("cluster-slam map match", [*shown, ("verdict", decision.reason)])
    return 0 if decision.accepted is not None else 1


def _match_rows(decision: Decision) -> list[list[str]]:
    return [
        [
            *(m.name, f"{m.log_ratio:.3f}", f"{p:.6f}"),
            *("true" if m is decision.accepted else "false", f"{m.evidence:.3f}"),
        ]
        for m, p in zip(decision.matches, decision.probabilities.tolist(), strict=True)
    ]


@app.command("list", short_help="Clusters of a map that answer a question.")
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

    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.ledger import ask
    from cluster_slam.io.map.times import iso

    with open_map(path) as store:
        rows = ask(store, where)
    if as_json:
        none = {"last_seen": None, "last_looked_at": None}
        clusters = [{k: none.get(k) if v != v else v for k, v in asdict(row).items()} for row in rows]
        print_json({"clusters": clusters})
    elif not quiet:
        shown = [
            (
                str(row.map_id),
                f"{row.plant}: {row.n_flowers} flowers at {row.x:.3f} {row.y:.3f} {row.z:.3f} m, "
                f"{row.state} ({row.presence:.2f}), last seen {iso(row.last_seen) or 'at an unknown time'}",
            )
            for row in rows
        ]
        print_table(f"{len(rows)} clusters", shown)
    return 0


@app.command("show", short_help="What is in a map.")
def show(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Show plants, sessions, clusters, flowers and events of a map.

    Example: cluster-slam map show field.map
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.ledger import events
    from cluster_slam.io.map.times import iso

    with open_map(path) as store:
        plants, sessions, ledger = store.plants(), store.sessions(), events(store)
    if as_json:
        print_json(
            {
                "plants": [
                    {"name": p.name, "clusters": len(p.cluster_ids), "flowers": len(p.flower_ids)} for p in plants
                ],
                "sessions": [{"id": s.session, "plant": s.plant, "probability": s.probability} for s in sessions],
                "events": len(ledger),
            }
        )
    elif not quiet:
        rows = [("map", str(path)), ("events", str(len(ledger)))]
        for p in plants:
            alive = int((p.flower_presence > 0.5).sum())
            rows.append(
                ("plant", f"{p.name}: {len(p.cluster_ids)} clusters, {alive} of {len(p.flower_ids)} flowers there")
            )
            for s in sessions:
                if s.plant == p.name:
                    rows.append(
                        ("  session", f"{iso(s.start) or 'no date'} {s.session} (alignment {s.probability:.3f})")
                    )
        print_table("cluster-slam map show", rows)
    return 0


@app.command("undo", short_help="Take the latest session out again.")
def undo(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Take the latest session out of a map again; all else is exactly as before it.

    Example: cluster-slam map undo field.map
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.write import undo as undo_session

    with open_map(path) as store:
        session = undo_session(store)
    if as_json:
        print_json({"undone": session.session, "plant": session.plant})
    elif not quiet:
        print_table("cluster-slam map undo", [("session", session.session), ("plant", session.plant)])
    return 0


@app.command("merge", short_help="Take the plants of another map in.")
def merge(
    path: MapArgument,
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="The other map; it is only read.", show_default=False)],
    prefix: Annotated[str, typer.Option("--prefix", help="Put before the names of its plants.")] = "",
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Take the plants of another map in, with sessions and events, all or nothing; ids are given anew.

    A plant that both maps have under one name is refused: give its sessions to `map add`, or use --prefix.

    Example: cluster-slam map merge field.map greenhouse.map --prefix greenhouse-
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.merge import merge_map

    with open_map(path) as store, open_map(other) as source:
        plants, clusters = merge_map(store, source, prefix)
    if as_json:
        print_json({"plants": plants, "clusters": clusters})
    elif not quiet:
        print_table("cluster-slam map merge", [("plants", ", ".join(plants) or "none"), ("clusters", str(clusters))])
    return 0


@app.command("optimise", short_help="Smooth all sessions of each plant together.")
def optimise(
    path: MapArgument,
    plant: Annotated[
        str | None, typer.Option("--plant", metavar="NAME", help="Only this plant.", show_default=False)
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Smooth all sessions of each plant in one graph: where each base stood, where each cluster is and how it drifts.

    Sessions before it can no longer be undone.

    Example: cluster-slam map optimise field.map --plant row3
    """
    from dataclasses import asdict

    from cluster_slam.io.map import open_map
    from cluster_slam.remember.optimise import optimise_plant

    with open_map(path) as store, StageProgress(is_shown=not (quiet or as_json)) as progress:
        names = store.plant_names() if plant is None else [store.plant(plant).name]
        found = []
        for k, name in enumerate(names):
            progress(f"smoothing {name}", k / len(names))
            found.append(optimise_plant(store, name))
    done = [each for each in found if each is not None]
    if as_json:
        print_json({"plants": [asdict(each) for each in done]})
    elif not quiet:
        text = "{} sessions, {} sightings, residuals {:.2f} -> {:.2f} sigma"
        rows = [(d.plant, text.format(d.n_sessions, d.n_sightings, d.rms_before, d.rms_after)) for d in done]
        print_table("cluster-slam map optimise", rows or [("verdict", "no plant has two sessions")])
    return 0


@app.command("event", short_help="Record what was done to a cluster.")
def event(
    path: MapArgument,
    cluster: Annotated[int, typer.Argument(metavar="CLUSTER", help="Its id in the map.", show_default=False)],
    kind: Annotated[str, typer.Argument(metavar="KIND", help="pollinated, harvested, note, ...", show_default=False)],
    time: Annotated[
        str | None, typer.Option("--time", metavar="ISO", help="When; default: now.", show_default=False)
    ] = None,
    note: Annotated[str, typer.Option("--note", help="A remark.")] = "",
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Record an event against a cluster; it stays with the cluster through all sessions.

    Example: cluster-slam map event field.map 17 pollinated --time 2026-05-04T10:30 --note "brush, second pass"
    """
    from time import time as clock

    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.ledger import record
    from cluster_slam.io.map.times import iso, seconds

    with open_map(path) as store:
        done = record(store, cluster, kind, clock() if time is None else seconds(time), note)
    if as_json:
        print_json({"event": done.id, "map_id": done.cluster, "kind": done.kind, "time": done.time, "note": done.note})
    elif not quiet:
        rows = [("event", str(done.id)), ("cluster", str(done.cluster)), ("kind", done.kind), ("time", iso(done.time))]
        print_table("cluster-slam map event", rows)
    return 0


@app.command("predict", short_help="Where each cluster will be on a date.")
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
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.export import predictions
    from cluster_slam.io.map.file import write_file
    from cluster_slam.io.map.times import seconds
    from cluster_slam.remember.predict import predict_plant

    options = configured(MapConfig(), config, settings or [])
    when = seconds(date)
    with open_map(path) as store:
        found = [predict_plant(plant, when, options) for plant in store.plants()]
    write_file(out, predictions([p for p, _ in found], [c for _, c in found]))
    n = sum(len(p.cluster_ids) for p, _ in found)
    if as_json:
        print_json({"out": str(out), "clusters": n})
    elif not quiet:
        print_table("cluster-slam map predict", [("clusters", str(n)), ("table", str(out))])
    return 0


@app.command("export", short_help="Write a map as plain tables.")
def export(
    path: MapArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="Folder to write.", show_default=False)],
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Write clusters, flowers, sessions and events of a map as CSV, and a g2o graph.

    Example: cluster-slam map export field.map -o out/export
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.export import export_map

    with open_map(path) as store:
        export_map(store, out)
    if as_json:
        print_json({"out": str(out)})
    elif not quiet:
        print_table("cluster-slam map export", [("folder", str(out))])
    return 0


@app.command("report", short_help="A page with a slider over dates.")
def report(
    path: MapArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE.html", help="Page to write.", show_default=False)],
    plant: Annotated[
        str | None, typer.Option("--plant", metavar="NAME", help="Only this plant.", show_default=False)
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Write the season report: plants in 3-D by date, life lines, drift, events, each alignment before and after.

    Example: cluster-slam map report field.map -o season.html
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.file import write_file
    from cluster_slam.report.season import render_season

    with open_map(path) as store:
        write_file(out, render_season(store, plant))
    if as_json:
        print_json({"out": str(out)})
    elif not quiet:
        print_table("cluster-slam map report", [("page", str(out))])
    return 0


@app.command("check", short_help="Is a map whole?")
def check(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Check that a map is whole: the file, what refers to what, all numbers. Exit code 1 and the reasons if it is not.

    Example: cluster-slam map check field.map
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.check import problems

    with open_map(path) as store:
        found = problems(store)
        n = len(store.sessions()) if not found else 0
    if as_json:
        print_json({"whole": not found, "problems": found})
    elif not quiet and not found:
        print_table("cluster-slam map check", [("map", str(path)), ("verdict", f"whole, {n} sessions")])
    if found:
        print_warnings(found)
    return 1 if found else 0
