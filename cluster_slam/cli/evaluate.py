"""``cluster-slam evaluate``: a result against the truth of its session."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption, SessionArgument
from cluster_slam.cli.summary import metric_rows, print_json, print_table
from cluster_slam.errors import InputError


def command(
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder.", show_default=False)],
    session: SessionArgument,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Compare a result with the truth of its session.

    Trajectory, hand-eye transform, identities, clutter, landmarks, and whether the covariances are true.

    Example: cluster-slam evaluate out/demo data/sample
    """
    from cluster_slam.evaluation import evaluate
    from cluster_slam.io.read_result import read_result
    from cluster_slam.io.run_record import read_run
    from cluster_slam.io.session import OBSERVED, open_session, open_truth

    opened = open_session(session, level=read_run(result / "run.json").level, observed=result / OBSERVED)
    truth = open_truth(session, opened)
    if truth is None:
        raise InputError(f"{session / 'truth'}: missing, expected ground truth to compare with")
    metrics = evaluate(read_result(result, opened), opened, truth).as_json()
    if as_json:
        print_json(metrics)
    elif not quiet:
        print_table(f"cluster-slam evaluate: {opened.id}", metric_rows(metrics))
    return 0
