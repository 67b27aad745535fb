"""``cluster-slam import``: recordings of other programs become sessions."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.io.importers.recording import Imported, ImportOptions
    from cluster_slam.io.importers.write import ImportReport

_UNITS = {"m": 1.0, "mm": 0.001}
_POOR_SHARE = 0.1  # of frames without a pose, or of images that cannot be read


def command(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="Recording: file or folder.", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="SESSION", help="Session; absent or empty.", show_default=False),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what is in SOURCE and write nothing.")] = False,
    colour: Annotated[str | None, typer.Option("--colour", metavar="TOPIC", show_default=False)] = None,
    depth: Annotated[str | None, typer.Option("--depth", metavar="TOPIC", show_default=False)] = None,
    camera_info: Annotated[str | None, typer.Option("--camera-info", metavar="TOPIC", show_default=False)] = None,
    pose: Annotated[
        str | None,
        typer.Option("--pose", metavar="TOPIC|'PARENT>CHILD'", help="Poses: topic, or tf.", show_default=False),
    ] = None,
    flowers: Annotated[
        str | None,
        typer.Option("--flowers", metavar="NAME", help="Topic or .mat variable of points.", show_default=False),
    ] = None,
    camera: Annotated[
        Path | None, typer.Option("--camera", metavar="FILE.yaml", help="Intrinsics.", show_default=False)
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option("--poses", metavar="FILE", help="TUM trajectory or RTDE log beside it.", show_default=False),
    ] = None,
    still: Annotated[bool, typer.Option("--still", help="The camera does not move; no poses are needed.")] = False,
    pose_frame: Annotated[
        str | None, typer.Option("--pose-frame", help="What poses are of: camera or flange.", show_default=False)
    ] = None,
    hand_eye: Annotated[
        str | None, typer.Option("--hand-eye", metavar="'TX TY TZ QX QY QZ QW'", show_default=False)
    ] = None,
    depth_scale: Annotated[
        float | None, typer.Option("--depth-scale", metavar="M", help="Metres per unit of depth.", show_default=False)
    ] = None,
    time_offset: Annotated[
        float, typer.Option("--time-offset", metavar="S", help="Added to the stamps of the poses.")
    ] = 0.0,
    rate: Annotated[float, typer.Option("--rate", metavar="HZ", min=1e-3, help="Of frames without stamps.")] = 30.0,
    unit: Annotated[
        str | None, typer.Option("--unit", help="Of positions in .csv and .mat: m or mm.", show_default=False)
    ] = None,
    plant: Annotated[str | None, typer.Option("--plant", help="Name of the plant.", show_default=False)] = None,
    id_: Annotated[str | None, typer.Option("--id", help="Name of the session.", show_default=False)] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Make a session of a recording of another program.

    Known are ROS 1 and ROS 2 bags, RealSense recordings, TUM RGB-D folders, Open3D captures, RTDE logs, and positions
    per frame as .csv or .mat. The format is seen from the content; topics are guessed, listed, and chosen by options.

    Example: cluster-slam import monday.mcap -o sessions/monday --dry-run
    """
    from cluster_slam.io.importers.recording import ImportOptions
    from cluster_slam.io.importers.session_files import check_free
    from cluster_slam.io.importers.source import read_source
    from cluster_slam.io.importers.write import write_imported

    options = ImportOptions(
        id_,
        plant,
        colour,
        depth,
        camera_info,
        pose,
        flowers,
        camera,
        poses,
        still,
        _pose_frame(pose_frame),
        None if hand_eye is None else _seven(hand_eye),
        depth_scale,
        time_offset,
        rate,
        _unit(unit),
    )
    if out is None and not dry_run:
        raise ConfigError("no -o SESSION, expected where to write (or --dry-run)")
    if out is not None and not dry_run:
        check_free(out)
    if dry_run:
        return _dry_run(source, options, quiet, as_json)
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        progress(f"reading {source.name}", 0.0)
        imported = read_source(source, options)
        report = write_imported(imported, Path(str(out)), progress)
    reasons = _poor(report)
    if as_json:
        facts = {**asdict(report), "format": imported.format, "out": str(out), "streams": _streams(imported)}
        print_json({**facts, "status": "poor" if reasons else "ok"})
    elif not quiet:
        print_warnings(report.warnings)
        print_table(
            f"cluster-slam import: {imported.format}", [*_used(imported), *_rows(report), ("session", str(out))]
        )
    if reasons:
        print_warnings([f"the import is poor: {'; '.join(reasons)}"])
    return 1 if reasons else 0


def _dry_run(source: Path, options: ImportOptions, quiet: bool, as_json: bool) -> int:
    """Say what is there; a recording that cannot be imported as it is says why, and what is in it."""
    from cluster_slam.errors import InputError
    from cluster_slam.io.importers.ros import bag_streams
    from cluster_slam.io.importers.ros_bag import is_bag
    from cluster_slam.io.importers.source import read_source

    is_ready = True
    try:
        imported = read_source(source, options)
        streams, words, warnings = list(imported.streams), imported.format, list(imported.warnings)
    except InputError as error:
        if not (source.exists() and is_bag(source)):
            raise
        streams, words, warnings = bag_streams(source, options), "bag", [str(error)]
        is_ready = False
    if as_json:
        listed = [asdict(s) | {"begin_s": _known(s.begin_s), "end_s": _known(s.end_s)} for s in streams]
        print_json({"format": words, "streams": listed, "warnings": warnings})
    elif not quiet:
        print_warnings(warnings)
        print_table(f"{source}: {words}", [(s.role, f"{s.name}: {s.n} of {s.kind}") for s in streams])
    return 0 if is_ready else 1


def _known(seconds: float) -> float | None:
    return seconds if seconds == seconds else None


def _streams(imported: Imported) -> list[dict[str, Any]]:
    return [{"name": s.name, "kind": s.kind, "n": s.n, "role": s.role} for s in imported.streams]


def _used(imported: Imported) -> list[tuple[str, str]]:
    return [(s.role, s.name) for s in imported.streams if s.role]


def _rows(report: ImportReport) -> list[tuple[str, str]]:
    rows = [("frames", str(report.n_frames)), ("frames without pose", str(report.n_without_pose))]
    rows += [("images", f"{report.n_colour} colour, {report.n_depth} depth")] if report.n_colour else []
    rows += [("unreadable", str(report.n_unreadable))] if report.n_unreadable else []
    rows += [("median depth", f"{report.median_depth_m:.3g} m")] if report.median_depth_m is not None else []
    rows += [("points", str(report.n_points))] if report.n_points or not report.n_colour else []
    return rows


def _poor(report: ImportReport) -> list[str]:
    reasons = []
    n = report.n_frames + report.n_without_pose
    if report.n_without_pose > _POOR_SHARE * n:
        reasons.append(f"{report.n_without_pose} of {n} frames have no pose")
    images = report.n_colour + report.n_depth + report.n_unreadable
    if report.n_unreadable > _POOR_SHARE * images:
        reasons.append(f"{report.n_unreadable} of {images} images cannot be read")
    return reasons


def _pose_frame(name: str | None) -> Literal["T_world_camera", "T_world_flange"] | None:
    if name not in (None, "camera", "flange"):
        raise ConfigError(f"--pose-frame {name!r}, expected camera or flange")
    return None if name is None else "T_world_camera" if name == "camera" else "T_world_flange"


def _unit(name: str | None) -> float | None:
    if name is not None and name not in _UNITS:
        raise ConfigError(f"--unit {name!r}, expected {' or '.join(_UNITS)}")
    return None if name is None else _UNITS[name]


def _seven(text: str) -> Any:
    """(7,) ``tx ty tz qx qy qz qw`` with a unit quaternion."""
    import numpy as np

    try:
        row = np.array([float(x) for x in text.replace(",", " ").split()])
    except ValueError:
        row = np.zeros(0)
    if row.shape != (7,) or not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1.0) > 0.01:
        raise ConfigError(f"--hand-eye {text!r}, expected tx ty tz qx qy qz qw with a unit quaternion")
    return row
