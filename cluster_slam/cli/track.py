"""``cluster-slam track``: clusters followed frame by frame, as if live."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
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
from cluster_slam.cli.stopping import Stopping
from cluster_slam.cli.summary import print_json, print_table, print_warnings, result_rows, truth_rows
from cluster_slam.cli.track_view import TrackView

if TYPE_CHECKING:
    from cluster_slam.config import OnlineConfig
    from cluster_slam.online.records import Update
    from cluster_slam.records import Calibration, Result, Session, Truth


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
    stream: Annotated[
        str | None,
        typer.Option("--stream", metavar="WHERE", help="JSON lines to - or tcp://127.0.0.1:PORT.", show_default=False),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where a run into OUT was cut off.")] = False,
    view: Annotated[bool, typer.Option("--view", help="A live picture in the terminal.")] = False,
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
    Ctrl-C and SIGTERM stop after a frame: --resume goes on from there, with the same identities.

    Example: cluster-slam track data/sample -o out/track
    """
    from cluster_slam.config import OnlineConfig
    from cluster_slam.errors import ConfigError
    from cluster_slam.io.read_result import read_calibration
    from cluster_slam.io.result import check_output
    from cluster_slam.io.session import open_session, open_truth

    if stream == "-" and as_json:
        raise ConfigError("--stream - and --json both want standard output, expected one of them")
    check_output(out)
    options = configured(OnlineConfig(), config, settings or [])
    known = None if calibration is None else read_calibration(calibration)
    started = perf_counter()
    opened = open_session(session, level=level)
    truth = open_truth(session, opened)
    is_shown = not (quiet or as_json or view)
    work = _Work(out, options, known, seed, realtime, resume, stream, view)
    with StageProgress(is_shown=is_shown) as progress, Stopping() as stopping:
        result, numbers = work.run(opened, truth, progress, stopping)
    if as_json:
        print_json({**json.loads((out / "run.json").read_text("utf-8")), "metrics": numbers, "out": str(out)})
    elif not quiet and stream != "-":
        _tell(result, numbers, out, perf_counter() - started)
    if result.status == "poor":
        print_warnings([f"the result is poor: {'; '.join(result.warnings) or 'see the report'}"])
    return 0 if result.status == "ok" else 1


@dataclass(frozen=True, slots=True)
class _Work:
    """What the options ask for."""

    out: Path
    options: OnlineConfig
    calibration: Calibration | None
    seed: int
    realtime: bool
    resume: bool
    stream: str | None
    view: bool

    def run(
        self, session: Session, truth: Truth | None, progress: StageProgress, stopping: Stopping
    ) -> tuple[Result, dict[str, float]]:
        """Track, evaluate where there is truth, render the report, write all of it."""
        from cluster_slam.evaluation import evaluate
        from cluster_slam.io.result import write_result
        from cluster_slam.online.journal import journal_of
        from cluster_slam.report.page import render_report

        result = self._track(session, progress, stopping)
        progress("evaluating", 0.95)
        metrics = None if truth is None else evaluate(result, session, truth)
        files: dict[str, str | bytes] = {"report.html": render_report(result, metrics)}
        numbers = {} if metrics is None else metrics.as_json()
        if metrics is not None:
            files["metrics.json"] = json.dumps(numbers, indent=2, allow_nan=False) + "\n"
        write_result(result, self.out, extra_files=files)
        rmtree(journal_of(self.out), ignore_errors=True)
        return result, numbers

    def _track(self, session: Session, progress: StageProgress, stopping: Stopping) -> Result:
        from cluster_slam.online.stream import open_stream
        from cluster_slam.pipeline.track import StoppedError, track

        with ExitStack() as stack:
            listeners: list[Callable[[Update], None]] = []
            lines = None if self.stream is None else open_stream(self.stream, patient=not self.realtime)
            if lines is not None:
                listeners.append(lines.put)
            if self.view:
                listeners.append(stack.enter_context(TrackView()).show)

            def tell(update: Update) -> None:
                for listen in listeners:
                    listen(update)

            try:
                result = track(
                    session,
                    calibration=self.calibration,
                    config=self.options,
                    seed=self.seed,
                    realtime=self.realtime,
                    out=self.out,
                    resume=self.resume,
                    progress=progress,
                    on_update=tell,
                    should_stop=stopping,
                )
            except StoppedError as stopped:
                sys.stderr.write(f"cluster-slam: {stopped}\n")
                raise SystemExit(128 + (stopping.signal or 0)) from None
            finally:
                lost = () if lines is None else lines.close()
        return replace(result, warnings=(*result.warnings, *lost))


def _tell(result: Result, metrics: Mapping[str, float], out: Path, seconds: float) -> None:
    print_warnings(result.warnings)
    times = result.timings_s
    ends = [("time", f"{seconds:.1f} s"), ("report", str(out / "report.html"))]
    if "frame_p50" in times:
        words = f"median {1e3 * times['frame_p50']:.1f} ms, one in a hundred {1e3 * times['frame_p99']:.1f} ms"
        ends.insert(0, ("a frame", f"{words} of processor time"))
    print_table(f"cluster-slam track: {result.status}", [*result_rows(result), *truth_rows(metrics), *ends])
