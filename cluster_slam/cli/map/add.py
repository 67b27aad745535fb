"""``map add``: a session is aligned with a map, recognised, and stored."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.map.options import AlignOption, MapArgument, is_similarity, opened
from cluster_slam.cli.map.told import added_json, overlap, tell_added, tell_completed
from cluster_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption, configured
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_warnings
from cluster_slam.config import MapConfig
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.io.map.incoming import Incoming
    from cluster_slam.io.map.store import MapStore, StoredSession

OptionalResult = Annotated[Path | None, typer.Argument(metavar="[RESULT]", help="Result folder.", show_default=False)]


def add(
    path: MapArgument,
    result: OptionalResult = None,
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
    from cluster_slam.io.map.complete import check_result, complete_result, replace_files
    from cluster_slam.pipeline.remember import add as add_session

    options = configured(MapConfig(), config, settings or [])
    similarity = is_similarity(align)
    started = perf_counter()
    with opened(path) as store, StageProgress(is_shown=not (quiet or as_json)) as progress:
        incoming = _incoming(result, landmarks, date, session)
        if result is not None:
            check_result(result)
        left = _left_incomplete(store, incoming, result)
        if left is not None and result is not None:
            complete_result(result, store, left)
            return tell_completed(left, quiet=quiet, as_json=as_json)
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
        print_json(added_json(added))
    elif not quiet:
        print_warnings([*incoming.warnings, *overlap(added)])
        tell_added(added, incoming, perf_counter() - started)
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
