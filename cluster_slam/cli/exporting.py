"""``cluster-slam export``: sessions and results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table
from cluster_slam.errors import ConfigError, InputError, OutputError

if TYPE_CHECKING:
    from cluster_slam.records import Result, Session

_SUFFIXES = {".mcap": "mcap", ".g2o": "g2o", ".txt": "tum", "": "tum"}


def command(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Session or result folder.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="OUT", help="File or folder; must not exist.")],
    format_: Annotated[
        str | None,
        typer.Option("--format", help="tum, mcap or g2o; else seen from the name of OUT.", show_default=False),
    ] = None,
    session: Annotated[
        Path | None,
        typer.Option("--session", metavar="SESSION", help="Of a result; else the recorded one.", show_default=False),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Write a session or a result in the format of another program.

    tum: the trajectory (OUT.txt), or a TUM RGB-D folder. mcap: a ROS 2 bag with tf, images and flowers. g2o: a graph of
    poses, flowers and observations.

    Example: cluster-slam export out/demo -o demo.g2o
    """
    kind = format_ or _SUFFIXES.get(out.suffix)
    if kind not in ("tum", "mcap", "g2o"):
        raise ConfigError(f"format {kind or out.suffix!r}, expected tum, mcap or g2o")
    _check_absent(out)
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        progress(f"reading {source.name}", 0.0)
        folder, opened, result = _open(source, session)
        progress(f"writing {out.name}", 0.5)
        counts = _write(kind, folder, opened, result, out)
    if as_json:
        print_json({"out": str(out), "format": kind, "counts": counts})
    elif not quiet:
        print_table(f"cluster-slam export: {kind}", [*((k, str(n)) for k, n in counts.items()), ("written", str(out))])
    return 0


def _check_absent(out: Path) -> None:
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise OutputError(f"{out}: exists, expected a free name")
    if not out.parent.is_dir():
        raise OutputError(f"{out}: no folder {out.parent}, expected one to write into")


def _open(source: Path, session: Path | None) -> tuple[Path, Session, Result | None]:
    """The session's folder, the session, and the result where the source is one."""
    from cluster_slam.io.read_result import read_result
    from cluster_slam.io.run_record import read_run

    if not (source / "run.json").is_file():
        return source, _session(source), None
    recorded = read_run(source / "run.json").session_path
    folder = session or (None if recorded is None else Path(recorded))
    if folder is None:
        raise InputError(f"{source / 'run.json'}: names no session, expected --session SESSION")
    opened = _session(folder)
    return folder, opened, read_result(source, opened)


def _session(folder: Path) -> Session:
    """The session; of images only, without observations."""
    from cluster_slam.io.exporters.pictures import open_pictures
    from cluster_slam.io.session import open_session, session_level

    return open_session(folder) if session_level(folder) > 1 else open_pictures(folder)


def _write(kind: str, folder: Path, session: Session, result: Result | None, out: Path) -> dict[str, int]:
    """Write; what is in it, by name."""
    from cluster_slam.geometry import tum_from_pose
    from cluster_slam.io.exporters.g2o import result_graph, session_graph
    from cluster_slam.io.exporters.mcap import export_mcap
    from cluster_slam.io.exporters.tum import camera_trajectory, export_tum
    from cluster_slam.io.importers.session_files import trajectory

    if kind == "mcap":
        if result is not None:
            raise ConfigError("a result as mcap, expected a session (a result goes to tum or g2o)")
        return export_mcap(session, folder, out)
    if kind == "g2o":
        text = session_graph(session) if result is None else result_graph(result)
        _write_text(out, text)
        words = [line.split(" ", 1)[0] for line in text.splitlines()]
        return {word: words.count(word) for word in sorted(set(words))}
    if out.suffix != ".txt" and result is None:
        return {"frames": session.n_frames, "images": export_tum(session, folder, out)}
    if result is not None:
        text = trajectory(session.stamps, tum_from_pose(result.T_world_camera))
    else:
        text = camera_trajectory(session, folder)
    _write_text(out, text)
    return {"frames": session.n_frames}


def _write_text(out: Path, text: str) -> None:
    """A file that is there whole or not at all."""
    new = out.with_name(f".{out.name}.new")
    try:
        new.write_text(text, "utf-8")
        new.rename(out)
    except OSError as error:
        new.unlink(missing_ok=True)
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None
