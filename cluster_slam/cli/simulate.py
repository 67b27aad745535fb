"""``cluster-slam simulate``: a session of a simulated plant, with its truth."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.options import ConfigOption, JsonOption, QuietOption, SeedOption, SetOption, configured
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table
from cluster_slam.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from cluster_slam.simulate.season import SeasonConfig

SIMULATED = "simulated-"  # how the id of a simulated session begins


def command(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Session folder to write.", show_default=False)],
    preset: Annotated[
        str,
        typer.Option(
            "--preset",
            metavar="NAME",
            help="moderate, hard, sample, or a strange one as moderate-tails; moderate-images renders; season: days.",
        ),
    ] = "moderate",
    seed: SeedOption = 0,
    config: ConfigOption = None,
    settings: SetOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Write a session of a simulated plant, with its truth.

    The same preset, options and seed give the same bytes.

    Example: cluster-slam simulate out/session --preset moderate --seed 3 --set sway_m=0.01
    """
    from dataclasses import asdict

    from cluster_slam.simulate import PRESETS, simulate
    from cluster_slam.simulate.season import SEASONS

    if preset in SEASONS:
        return _season(out, preset, configured(SEASONS[preset], config, settings or []), seed, quiet, as_json)
    if preset not in PRESETS:
        near = difflib.get_close_matches(preset, PRESETS, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(f"unknown preset {preset!r}{hint} (known: {', '.join([*PRESETS, *SEASONS])})")
    _check_replaceable(out)
    options = configured(PRESETS[preset], config, settings or [])
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        progress("simulating", 0.0)
        simulate(options, out, seed=seed, progress=progress)
    if as_json:
        print_json({"out": str(out), "preset": preset, "seed": seed, "config": asdict(options)})
    elif not quiet:
        print_table("cluster-slam simulate", [("preset", preset), ("seed", str(seed)), ("session", str(out))])
    return 0


def _season(out: Path, preset: str, options: SeasonConfig, seed: int, quiet: bool, as_json: bool) -> int:
    """Write a folder a day of a season."""
    from dataclasses import asdict

    from cluster_slam.simulate.season import simulate_season

    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        progress("simulating", 0.0)
        folders = simulate_season(options, out, seed=seed)
    if as_json:
        sessions = [str(folder) for folder in folders]
        print_json({"out": str(out), "preset": preset, "seed": seed, "sessions": sessions, "config": asdict(options)})
    elif not quiet:
        rows = [("preset", preset), ("seed", str(seed)), *(("session", str(folder)) for folder in folders)]
        print_table("cluster-slam simulate", rows)
    return 0


def _check_replaceable(out: Path) -> None:
    """Refuse a folder with a session that somebody recorded.

    Raises
    ------
    OutputError
        The session there is not a simulated one.
    """
    from cluster_slam.io.metadata import read_metadata

    path = out / "session.toml"
    if path.exists() and not (found := read_metadata(path)[0].id).startswith(SIMULATED):
        raise OutputError(f"{out}: holds the session {found!r}, which is not simulated, expected a free name")
