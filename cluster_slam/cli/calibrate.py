"""``cluster-slam calibrate``: how the camera is mounted on the flange."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cluster_slam.cli.options import JsonOption, QuietOption, SeedOption, SessionArgument
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings

if TYPE_CHECKING:
    from cluster_slam.pipeline.calibrate_report import CalibrationReport


def command(
    session: SessionArgument,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Result folder; an earlier result in it is replaced.")
    ],
    board: Annotated[
        str | None,
        typer.Option(
            "--board",
            metavar="SPEC",
            help="Calibrate by a board in the pictures: charuco:7x5:0.04:0.03:4X4_50 (squares, their side and the "
            "marker's side in m, dictionary) or apriltag:36h11:0.08.",
            show_default=False,
        ),
    ] = None,
    time_offset: Annotated[bool, typer.Option("--time-offset", help="Find the offset of the clocks too.")] = False,
    depth_scale: Annotated[bool, typer.Option("--depth-scale", help="Find the scale of the distances too.")] = False,
    seed: SeedOption = 0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Find the hand-eye transform of a session from the flowers themselves, or from a board in its pictures.

    OUT gets calibration.toml (T_flange_camera with its covariance, and advice on which motions are missing).

    Example: cluster-slam calibrate session -o out/mount --time-offset
    """
    from cluster_slam.io.result import check_output

    check_output(out)
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        found = _found(session, board, time_offset, depth_scale, seed, progress)
    run = _write(found, out)
    if as_json:
        print_json({**run, "out": str(out)})
    elif not quiet:
        _tell(found, out)
    if found.status == "poor":
        print_warnings([f"the result is poor: {'; '.join([*found.warnings, *found.advice])}"])
    return 0 if found.status == "ok" else 1


def _found(
    path: Path, board: str | None, time_offset: bool, depth_scale: bool, seed: int, progress: StageProgress
) -> CalibrationReport:
    from cluster_slam.pipeline.calibrate import calibrate

    if board is not None:
        from cluster_slam.pipeline.calibrate_board import calibrate_pictures

        return calibrate_pictures(path, board, time_offset=time_offset, depth_scale=depth_scale, progress=progress)
    from cluster_slam.io.session import open_session

    return calibrate(open_session(path), time_offset=time_offset, depth_scale=depth_scale, seed=seed, progress=progress)


def _write(found: CalibrationReport, out: Path) -> dict[str, Any]:
    import os
    from importlib.metadata import version

    from cluster_slam.io.folder import write_folder

    mounting = found.mounting
    run = {
        "version": version("cluster-slam"),
        "command": "calibrate",
        "session": found.session.id,
        "session_path": None if found.session.path is None else os.path.abspath(found.session.path),
        "level": found.session.level,
        "config": {"source": found.source, "time_offset": found.with_time, "depth_scale": found.with_scale},
        "seed": 0,
        "timings_s": found.timings_s,
        "counts": {"frames": found.session.n_frames, "observations": found.n_used},
        "estimated_noise": {"scatter": mounting.scatter_m},
        "warnings": [*found.warnings, *found.advice],
        "merged": [],
        "status": found.status,
        "files": ["calibration.toml", "run.json"],
    }
    write_folder(out, {"calibration.toml": calibration_text(found), "run.json": json.dumps(run, indent=2) + "\n"})
    return run


def calibration_text(found: CalibrationReport) -> str:
    """``calibration.toml``: the fixed part first, then what else was found."""
    import numpy as np

    from cluster_slam.geometry import tum_from_pose

    m = found.mounting
    rows = [f"  [{', '.join(f'{x:.12g}' for x in row)}]," for row in m.cov[:6, :6].tolist()]
    sigma = np.sqrt(np.diag(m.cov))
    lines = [
        "# tx ty tz qx qy qz qw; the covariance is of [rx ry rz tx ty tz], applied on the right",
        f"T_flange_camera = [{', '.join(f'{x:.12g}' for x in tum_from_pose(m.X).tolist())}]",
        "covariance = [",
        *rows,
        "]",
        "# directions that the session could not show; they stay at the prior",
        f"unobserved = [{', '.join(json.dumps(w) for w in found.unobserved)}]",
        "# what would make it surer",
        f"advice = [{', '.join(json.dumps(w) for w in found.advice)}]",
        "# root mean square turn about each axis of the flange, rad",
        f"excitation = [{', '.join(f'{x:.6g}' for x in found.excitation_rad.tolist())}]",
        "# median distance of the observations from their points' places, m",
        f"scatter = {m.scatter_m:.9g}",
    ]
    if found.with_time:
        lines += [
            "# the picture of stamp t shows the arm at t + time_offset, s",
            f"time_offset = {m.time_offset_s:.9g}",
            f"time_offset_sigma = {sigma[6]:.9g}",
        ]
    if found.with_scale:
        lines += [
            "# true distance over measured",
            f"depth_scale = {m.depth_scale:.9g}",
            f"depth_scale_sigma = {sigma[-1]:.9g}",
        ]
    return "\n".join([*lines, ""])


def _tell(found: CalibrationReport, out: Path) -> None:
    import numpy as np

    m = found.mounting
    sigma = np.sqrt(np.diag(m.cov))
    rows = [
        ("session", found.session.id),
        ("from", f"{found.n_used} observations of {found.source}"),
        ("scatter (median)", f"{1e3 * m.scatter_m:.2f} mm"),
        ("place (m)", "  ".join(f"{x:+.5f} ± {s:.5f}" for x, s in zip(m.X[:3, 3], sigma[3:6], strict=True))),
        ("turn (deg, one sigma)", "  ".join(f"{np.degrees(s):.3f}" for s in sigma[:3])),
        ("flange turned (deg, RMS)", "  ".join(f"{np.degrees(x):.1f}" for x in found.excitation_rad)),
    ]
    if found.with_time:
        rows.append(("time offset", f"{1e3 * m.time_offset_s:+.2f} ± {1e3 * sigma[6]:.2f} ms"))
    if found.with_scale:
        rows.append(("depth scale", f"{m.depth_scale:.5f} ± {sigma[-1]:.5f}"))
    rows += [("not observable", ", ".join(found.unobserved))] if found.unobserved else []
    print_table(
        f"cluster-slam calibrate: {found.status}", [*rows, *(("advice", a) for a in found.advice), ("result", str(out))]
    )
