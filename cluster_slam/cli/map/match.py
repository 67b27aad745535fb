"""``map match``: which plant of a map a result shows, and how sure that is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cluster_slam.cli.map.options import AlignOption, MapArgument, ResultArgument, is_similarity, opened, print_columns
from cluster_slam.cli.options import ConfigOption, JsonOption, QuietOption, SetOption, configured
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json
from cluster_slam.config import MapConfig

if TYPE_CHECKING:
    from cluster_slam.remember.decide import Decision

HEADER = ("plant", "log_likelihood_ratio", "probability", "accepted", "evidence")
SHOWN = 10


def match(
    path: MapArgument,
    result: ResultArgument,
    align: AlignOption = "rigid",
    config: ConfigOption = None,
    settings: SetOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Rank all plants of a map by how well a result fits them; writes matches.csv into the result.

    Example: cluster-slam map match field.map out/unknown
    """
    from cluster_slam.io.map.complete import check_result, replace_files
    from cluster_slam.io.map.export import table
    from cluster_slam.io.map.incoming import read_incoming
    from cluster_slam.pipeline.remember import match_all

    options, similarity = configured(MapConfig(), config, settings or []), is_similarity(align)
    with opened(path) as store, StageProgress(is_shown=not (quiet or as_json)) as progress:
        incoming = read_incoming(result)
        check_result(result)
        decision = match_all(store, incoming, similarity=similarity, config=options, progress=progress)
    rows = _rows(decision)
    replace_files(result, {"matches.csv": table(HEADER, rows)}, {})
    if as_json:
        named = [dict(zip(HEADER, row, strict=True)) for row in rows]
        print_json({"matches": named, "refusal": decision.refusal.value, "reason": decision.reason})
    elif not quiet:
        print_columns("cluster-slam map match", [name.replace("_", " ") for name in HEADER], rows[:SHOWN])
        print_columns(f"verdict: {decision.reason}", (), ())
    return 0 if decision.accepted is not None else 1


def _rows(decision: Decision) -> list[list[str]]:
    return [
        [
            *(m.name, f"{m.log_ratio:.3f}", f"{p:.6f}"),
            *("true" if m is decision.accepted else "false", f"{m.evidence:.3f}"),
        ]
        for m, p in zip(decision.matches, decision.probabilities.tolist(), strict=True)
    ]
