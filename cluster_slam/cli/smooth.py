"""``cluster-slam smooth``: a recorded session becomes a map of flower clusters."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.detect import DetectorOption, ModelOption, detector_for
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
from cluster_slam.config import SmoothConfig
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.evaluation import Metrics
    from cluster_slam.records import Result, Session, Truth


def command(
    session: SessionArgument,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Result folder; an earlier result in it is replaced.")
    ],
    config: ConfigOption = None,
    settings: SetOption = None,
    level: Annotated[
        int | None,
        typer.Option("--level", help="3 flowers, 2 detections, 1 pictures; default: the highest.", show_default=False),
    ] = None,
    model: ModelOption = None,
    detector: DetectorOption = None,
    seed: SeedOption = 0,
    grouping: Annotated[
        str | None,
        typer.Option("--grouping", metavar="METHOD", help="spacing, kmeans, branch or none.", show_default=False),
    ] = None,
    clusters: Annotated[
        int | None,
        typer.Option("--clusters", metavar="N", min=1, help="Number of clusters, for kmeans.", show_default=False),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Turn a recorded session into a map of flower clusters.

    OUT gets the trajectory, the hand-eye transform, clusters and flowers with covariances, which observation is of
    which flower, what was clutter, and a report.

    Example: cluster-slam smooth data/sample -o out/demo
    """
    from cluster_slam.io.result import check_output, write_result
    from cluster_slam.io.session import open_session, open_truth

    check_output(out)
    options = smooth_config(config, settings or [], grouping, clusters)
    started = perf_counter()
    finder = detector_for(session, level, model, detector)
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        opened = open_session(session, level=1 if finder else level, detector=finder, progress=progress)
        truth = open_truth(session, opened)
        read_s = perf_counter() - started
        result, metrics, files = _work(opened, truth, options, seed, read_s, progress)
        write_result(result, out, extra_files=files)
    known = {} if metrics is None else metrics.as_json()
    if as_json:
        print_json({**json.loads((out / "run.json").read_text("utf-8")), "metrics": known, "out": str(out)})
    elif not quiet:
        _tell(result, known, out, perf_counter() - started)
    if result.status == "poor":
        reasons = [text for text in result.warnings if text not in opened.warnings]
        print_warnings([f"the result is poor: {'; '.join(reasons) or 'see the report'}"])
    return 0 if result.status == "ok" else 1


def smooth_config(file: Path | None, settings: list[str], grouping: str | None, clusters: int | None) -> SmoothConfig:
    """The options of the method: the file's, then ``--set``, then ``--grouping`` and ``--clusters``.

    Raises
    ------
    ConfigError
        An option is unknown or wrong, or ``kmeans`` and the number of clusters do not come together.
    """
    method = grouping or ("kmeans" if clusters is not None else None)
    more = [] if method is None else [f"grouping.method='{method}'"]
    more += [] if clusters is None else [f"grouping.n_clusters={clusters}"]
    options = configured(SmoothConfig(), file, [*settings, *more])
    chosen = options.grouping
    if (chosen.method == "kmeans") != (chosen.n_clusters is not None):
        given = f"grouping {chosen.method} with {chosen.n_clusters or 'no'} clusters"
        raise ConfigError(f"{given}, expected a number of clusters with kmeans, and only there (--clusters N)")
    return options


def _work(
    session: Session, truth: Truth | None, options: SmoothConfig, seed: int, read_s: float, progress: StageProgress
) -> tuple[Result, Metrics | None, dict[str, str | bytes]]:
    """Smooth, evaluate where there is truth, and render the report."""
    from dataclasses import asdict, replace

    from cluster_slam.evaluation import evaluate
    from cluster_slam.io.session import OBSERVED
    from cluster_slam.io.session_writer import observed_table
    from cluster_slam.pipeline.smooth import smooth
    from cluster_slam.report.page import render_report

    result = smooth(session, config=options, seed=seed, progress=progress)
    warnings = tuple(dict.fromkeys([*session.warnings, *result.warnings]))
    result = replace(result, warnings=warnings, seed=seed, config=result.config or asdict(options))
    begin = perf_counter()
    progress("evaluating", 0.95)
    metrics = None if truth is None else evaluate(result, session, truth)
    evaluated = perf_counter()
    progress("writing the report", 0.97)
    page = render_report(result, metrics)
    more = {"read": read_s, "evaluate": evaluated - begin, "report": perf_counter() - evaluated}
    result = replace(result, timings_s={**result.timings_s, **more})
    files: dict[str, str | bytes] = {"report.html": page}
    if session.level == 1:  # what was detected, so that no picture need be opened again
        files[OBSERVED] = observed_table(session)
    if metrics is not None:
        files["metrics.json"] = json.dumps(metrics.as_json(), indent=2, allow_nan=False) + "\n"
    return result, metrics, files


def _tell(result: Result, metrics: Mapping[str, float], out: Path, seconds: float) -> None:
    print_warnings(result.warnings)
    ends = [("time", f"{seconds:.1f} s"), ("report", str(out / "report.html"))]
    print_table(f"cluster-slam smooth: {result.status}", [*result_rows(result), *truth_rows(metrics), *ends])
