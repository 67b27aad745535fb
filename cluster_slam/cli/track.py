"""``cluster-slam track``: clusters followed frame by frame, as if live."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.options import (
    ConfigOption,
    JsonOption,
    QuietOption,
    SeedOption,
    SessionArgument,
    SetOption,
    configured,
)
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings, result_rows, truth_rows

if TYPE_CHECKING:
    from cluster_slam.records import Result


def command(
    session: SessionArgument,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Result folder; an earlier result in it is replaced.")
    ],
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="calibration.toml as smooth writes it.", show_default=False),
    ] = None,
    realtime: Annotated[bool, typer.Option("--realtime", help="At the pace of the recording.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a run into OUT was cut off.")] = False,
    config: ConfigOption = None,
    settings: SetOption = None,
    level: Annotated[
        int | None, typer.Option("--level", help="3 flowers, 2 detections; default: the highest.", show_default=False)
    ] = None,
    seed: SeedOption = 0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Follow the clusters of a session frame by frame, as if it were live.

    Each row of the result is what was known when its frame had just been processed; no later frame improves it.

    Example: cluster-slam track data/sample -o out/track
    """
    from cluster_slam.config import OnlineConfig
    from cluster_slam.evaluation import evaluate
    from cluster_slam.io.read_result import read_calibration
    from cluster_slam.io.result import check_output, write_result
    from cluster_slam.io.session import open_session, open_truth
    from cluster_slam.online.journal import journal_of
    from cluster_slam.pipeline.track import track
    from cluster_slam.report.page import render_report

    check_output(out)
    options = configured(OnlineConfig(), config, settings or [])
    known = None if calibration is None else read_calibration(calibration)
    started = perf_counter()
    opened = open_session(session, level=level)
    truth = open_truth(session, opened)
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        result = track(
            opened,
            calibration=known,
            config=options,
            seed=seed,
            realtime=realtime,
            out=out,
            resume=resume,
            progress=progress,
        )
        progress("evaluating", 0.95)
        metrics = None if truth is None else evaluate(result, opened, truth)
        result = replace(result, config=result.config or asdict(options))
        files: dict[str, str | bytes] = {"report.html": render_report(result, metrics)}
        if metrics is not None:
            files["metrics.json"] = json.dumps(metrics.as_json(), indent=2, allow_nan=False) + "\n"
        write_result(result, out, extra_files=files)
    _clear(journal_of(out))
    numbers = {} if metrics is None else metrics.as_json()
    if as_json:
        print_json({**json.loads((out / "run.json").read_text("utf-8")), "metrics": numbers, "out": str(out)})
    elif not quiet:
        _tell(result, numbers, out, perf_counter() - started)
    if result.status == "poor":
        print_warnings([f"the result is poor: {'; '.join(result.warnings) or 'see the report'}"])
    return 0 if result.status == "ok" else 1


def _clear(journal: Path) -> None:
    """The result stands: its journal is not needed any more."""
    import shutil

    shutil.rmtree(journal, ignore_errors=True)


def _tell(result: Result, metrics: Mapping[str, float], out: Path, seconds: float) -> None:
    print_warnings(result.warnings)
    times = result.timings_s
    ends = [("time", f"{seconds:.1f} s"), ("report", str(out / "report.html"))]
    if "frame_p50" in times:
        words = f"median {1e3 * times['frame_p50']:.1f} ms, one in a hundred {1e3 * times['frame_p99']:.1f} ms"
        ends.insert(0, ("a frame", f"{words} of processor time"))
    print_table(f"cluster-slam track: {result.status}", [*result_rows(result), *truth_rows(metrics), *ends])
