"""``map create``, ``undo``, ``merge`` and ``optimise``: what changes a map as a whole."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cluster_slam.cli.map.options import MapArgument, PlantOption, opened, tell
from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.errors import ConfigError


def create(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Make an empty map.

    Example: cluster-slam map create field.map
    """
    from cluster_slam.io.map import create_map

    create_map(path).close()
    tell("cluster-slam map create", {"map": str(path)}, [("map", str(path))], quiet=quiet, as_json=as_json)
    return 0


def undo(path: MapArgument, quiet: QuietOption = False, as_json: JsonOption = False) -> int:
    """Take the latest session out of a map again; all else is exactly as before it.

    Example: cluster-slam map undo field.map
    """
    from cluster_slam.io.map.write import undo as undo_session

    with opened(path) as store:
        session = undo_session(store)
    value = {"undone": session.session, "plant": session.plant}
    tell("cluster-slam map undo", value, list(value.items()), quiet=quiet, as_json=as_json)
    return 0


def merge(
    path: MapArgument,
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="The other map; it is only read.", show_default=False)],
    prefix: Annotated[str, typer.Option("--prefix", help="Put before the names of its plants.")] = "",
    rename: Annotated[
        list[str] | None,
        typer.Option(
            "--rename", metavar="OLD=NEW", help="Another name for a plant; may be repeated.", show_default=False
        ),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Take the plants of another map in, with sessions and events, all or nothing; ids are given anew.

    A plant that both maps have under one name is refused, as each is in a frame of its own. Is it another plant? Use
    --rename or --prefix. Is it the same one? Give its sessions' results to `map add`, which aligns them.

    Example: cluster-slam map merge field.map greenhouse.map --rename row3=greenhouse-row3
    """
    from cluster_slam.io.map.merge import merge_map

    with opened(path) as store, opened(other) as source:
        plants, clusters = merge_map(store, source, prefix, dict(_renaming(word) for word in rename or []))
    value = {"plants": plants, "clusters": clusters}
    rows = [("plants", ", ".join(plants) or "none"), ("clusters", str(clusters))]
    tell("cluster-slam map merge", value, rows, quiet=quiet, as_json=as_json)
    return 0


def _renaming(word: str) -> tuple[str, str]:
    old, equals, new = word.partition("=")
    if not (equals and old.strip() and new.strip()):
        raise ConfigError(f"--rename {word!r}, expected OLD=NEW, as in --rename row3=greenhouse-row3")
    return old.strip(), new.strip()


def optimise(
    path: MapArgument,
    plant: PlantOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Smooth all sessions of each plant in one graph: where each base stood, where each cluster is and how it drifts.

    Sessions before it can no longer be undone.

    Example: cluster-slam map optimise field.map --plant row3
    """
    from dataclasses import asdict

    from cluster_slam.remember.optimise import optimise_plant

    with opened(path) as store, StageProgress(is_shown=not (quiet or as_json)) as progress:
        names = store.plant_names() if plant is None else [store.plant(plant).name]
        found = []
        for k, name in enumerate(names):
            progress(f"smoothing {name}", k / len(names))
            found.append(optimise_plant(store, name))
    done = [each for each in found if each is not None]
    text = "{} sessions, {} sightings, residuals {:.2f} -> {:.2f} sigma"
    rows = [(d.plant, text.format(d.n_sessions, d.n_sightings, d.rms_before, d.rms_after)) for d in done]
    rows = rows or [("verdict", "nothing to do: no plant has two sessions")]
    value = {"plants": [asdict(each) for each in done]}
    tell("cluster-slam map optimise", value, rows, quiet=quiet, as_json=as_json)
    return 0
