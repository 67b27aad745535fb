"""``cluster-slam track``: clusters followed frame by frame, as if live."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.detect import DetectorOption, ModelOption, detector_for
from cluster_slam.cli.options import (
    ConfigOption,
    JsonOption,
    QuietOption,
    SeedOption,
    SetOption,
    configured,
)
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.stopping import Stopping
from cluster_slam.cli.summary import print_json, print_table, print_warnings, result_rows, truth_rows
from cluster_slam.cli.track_live import Listeners, LiveOptions, follow_robot
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.config import OnlineConfig
    from cluster_slam.evaluation import Metrics
    from cluster_slam.io.observed import Detector
    from cluster_slam.records import Result


def command(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Result folder; an earlier result in it is replaced.")
    ],
    session: Annotated[
        Path | None, typer.Argument(metavar="SESSION", help="Session folder.", show_default=False)
    ] = None,
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="HOST", help="Follow this arm, live.", show_default=False)
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option("--camera", metavar="CAMERA", help="On the arm: realsense, or a folder.", show_default=False),
    ] = None,
    hand_eye: Annotated[
        str | None,
        typer.Option(
            "--hand-eye",
            metavar="'TX TY TZ QX QY QZ QW'",
            help="Camera on the TCP, measured.",
            show_default=False,
        ),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option("--duration", metavar="S", min=0, help="With --robot: end after so long.", show_default=False),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option("--record", metavar="SESSION", help="With --robot: keep what came in.", show_default=False),
    ] = None,
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
        int | None,
        typer.Option("--level", help="3 flowers, 2 detections, 1 pictures; default: the highest.", show_default=False),
    ] = None,
    model: ModelOption = None,
    detector: DetectorOption = None,
    seed: SeedOption = 0,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Follow the clusters of a session frame by frame, as if it were live, or those before a robot's camera.

    Each row of the result is what was known when its frame had just been processed; no later frame improves it.
    Ctrl-C and SIGTERM stop after a frame: a session goes on from there with --resume, with the same identities; a
    live run ends in order, with its result. The arm is only listened to.

    Example: cluster-slam track data/sample -o out/track

    Example: cluster-slam track --robot 192.168.1.10 --camera realsense --calibration calibration.toml -o out/live
    """
    from cluster_slam.config import OnlineConfig
    from cluster_slam.io.result import check_output

    live = LiveOptions(robot, camera, hand_eye, duration, record, calibration, model, detector)
    _check(session, live, level, realtime, stream, as_json)
    check_output(out)
    options = configured(OnlineConfig(), config, settings or [])
    started = perf_counter()
    is_shown = not (quiet or as_json or view)
    how = _How(out, options, calibration, seed, realtime, resume, stream, view)
    with StageProgress(is_shown=is_shown) as progress, Stopping() as stopping:
        if session is None:
            result, numbers = how.follow(live, progress, stopping)
        else:
            finder = detector_for(session, level, model, detector)
            result, numbers = how.replay(session, level, finder, progress, stopping)
    if as_json:
        print_json({**json.loads((out / "run.json").read_text("utf-8")), "metrics": numbers, "out": str(out)})
    elif not quiet and stream != "-":
        _tell(result, numbers, out, perf_counter() - started)
    if result.status == "poor":
        print_warnings([f"the result is poor: {'; '.join(result.warnings) or 'see the report'}"])
    return 0 if result.status == "ok" else 1


def _check(
    session: Path | None, live: LiveOptions, level: int | None, realtime: bool, stream: str | None, as_json: bool
) -> None:
    """Refuse options that do not go together."""
    if stream == "-" and as_json:
        raise ConfigError("--stream - and --json both want standard output, expected one of them")
    if (session is None) == (live.host is None):
        raise ConfigError("expected a SESSION or --robot HOST, and not both")
    if live.host is None:
        live.check_unused()
    else:
        live.check()
        if realtime or level is not None:
            raise ConfigError("--realtime and --level are of a session, expected none with --robot")


@dataclass(frozen=True, slots=True)
class _How:
    """What the options ask for, whatever is followed."""

    out: Path
    options: OnlineConfig
    calibration: Path | None
    seed: int
    realtime: bool
    resume: bool
    stream: str | None
    view: bool

    def replay(
        self, folder: Path, level: int | None, finder: Detector | None, progress: StageProgress, stopping: Stopping
    ) -> tuple[Result, dict[str, float]]:
        """A session, as if live; evaluated where there is truth."""
        from cluster_slam.evaluation import evaluate
        from cluster_slam.io.read_result import read_calibration
        from cluster_slam.io.session import open_session, open_truth
        from cluster_slam.pipeline.track import StoppedError, track

        known = None if self.calibration is None else read_calibration(self.calibration)
        session = open_session(folder, level=1 if finder else level, detector=finder, progress=progress)
        truth = open_truth(folder, session)
        try:
            with Listeners(self.stream, self.view, patient=not self.realtime) as listeners:
                result = track(
                    session,
                    calibration=known,
                    config=self.options,
                    seed=self.seed,
                    realtime=self.realtime,
                    out=self.out,
                    resume=self.resume,
                    progress=progress,
                    on_update=listeners,
                    should_stop=stopping,
                )
        except StoppedError as stopped:
            sys.stderr.write(f"cluster-slam: {stopped}\n")
            raise SystemExit(128 + (stopping.signal or 0)) from None
        progress("evaluating", 0.95)
        result = replace(result, warnings=(*result.warnings, *listeners.lost))
        metrics = None if truth is None else evaluate(result, session, truth)
        self._write(result, metrics)
        return result, {} if metrics is None else metrics.as_json()

    def follow(self, live: LiveOptions, progress: StageProgress, stopping: Stopping) -> tuple[Result, dict[str, float]]:
        """A robot's camera, until it ends or somebody wants to stop."""
        with Listeners(self.stream, self.view, patient=False) as listeners:
            result = follow_robot(live, self.out, self.options, self.seed, self.resume, listeners, progress, stopping)
        result = replace(result, warnings=(*result.warnings, *listeners.lost))
        self._write(result, None)
        return result, {}

    def _write(self, result: Result, metrics: Metrics | None) -> None:
        from cluster_slam.io.result import write_result
        from cluster_slam.io.session import OBSERVED
        from cluster_slam.io.session_writer import observed_table
        from cluster_slam.online.journal import journal_of, read_journal
        from cluster_slam.pipeline.track import instants_of
        from cluster_slam.report.page import render_report
        from cluster_slam.report.replay import with_replay

        page = with_replay(render_report(result, metrics), result, instants_of(read_journal(journal_of(self.out))))
        files: dict[str, str | bytes] = {"report.html": page}
        if metrics is not None:
            files["metrics.json"] = json.dumps(metrics.as_json(), indent=2, allow_nan=False) + "\n"
        if result.session.level == 1:  # what was detected, so that no picture need be opened again
            files[OBSERVED] = observed_table(result.session)
        write_result(result, self.out, extra_files=files)
        rmtree(journal_of(self.out), ignore_errors=True)


def _tell(result: Result, metrics: Mapping[str, float], out: Path, seconds: float) -> None:
    print_warnings(result.warnings)
    times = result.timings_s
    ends = [("time", f"{seconds:.1f} s"), ("report", str(out / "report.html"))]
    if "frame_p50" in times:
        words = f"median {1e3 * times['frame_p50']:.1f} ms, one in a hundred {1e3 * times['frame_p99']:.1f} ms"
        ends.insert(0, ("a frame", f"{words} of processor time"))
    print_table(f"cluster-slam track: {result.status}", [*result_rows(result), *truth_rows(metrics), *ends])
