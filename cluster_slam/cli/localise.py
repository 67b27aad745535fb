"""``cluster-slam localise``: where the camera is in a saved map."""

from __future__ import annotations

import json
from pathlib import Path
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
from cluster_slam.cli.summary import print_json, print_table, print_warnings
from cluster_slam.config import LocaliseConfig

if TYPE_CHECKING:
    from cluster_slam.records import SessionLocalisation


def command(
    session: SessionArgument,
    map_file: Annotated[Path, typer.Option("--map", "-m", metavar="MAP", help="Map file.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Result folder; an earlier result in it is replaced.")
    ],
    independent: Annotated[
        bool, typer.Option("--independent", help="Every frame by itself; poses.txt gives stamps only.")
    ] = False,
    window: Annotated[
        int | None,
        typer.Option(
            "--window", metavar="N", min=1, help="Each frame from the last N frames only.", show_default=False
        ),
    ] = None,
    smooth: Annotated[bool, typer.Option("--smooth", help="Poses from all frames, later ones too.")] = False,
    seed: SeedOption = 0,
    config: ConfigOption = None,
    settings: SetOption = None,
    level: Annotated[
        int | None, typer.Option("--level", help="3 flowers, 2 detections; default: the highest.", show_default=False)
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Say where the camera was in a map, frame by frame, with no prior, and how sure that is.

    A frame is located only where the pose is sure; all others are lost, with the reason. Of poses.txt only the motion
    from frame to frame is used.

    Example: cluster-slam localise session --map field.map -o out/where
    """
    from cluster_slam.io.localisation import write_localisation
    from cluster_slam.io.map import open_map
    from cluster_slam.io.result import check_output
    from cluster_slam.io.session import open_session
    from cluster_slam.pipeline.localise import localise
    from cluster_slam.report.localised import localisation_picture
    from cluster_slam.report.localised_page import localisation_page

    check_output(out)
    options = configured(LocaliseConfig(), config, settings or [])
    opened = open_session(session, level=level)
    with open_map(map_file) as store:
        name = opened.plant
        plants = [store.plant(name)] if name is not None and name in store.plant_names() else store.plants()
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        found = localise(
            opened,
            plants,
            config=options,
            independent=independent,
            window=window,
            smooth=smooth,
            seed=seed,
            progress=progress,
        )
        metrics = _metrics(found, session)
        picture = localisation_picture(found, plants)
        page = localisation_page(found, _against_truth(metrics), picture)
        extra: dict[str, str | bytes] = {"localisation.svg": picture, "report.html": page}
        if metrics:
            extra["metrics.json"] = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
        write_localisation(found, out, extra_files=extra)
    if as_json:
        print_json({**json.loads((out / "run.json").read_text("utf-8")), "metrics": metrics, "out": str(out)})
    elif not quiet:
        _tell(found, metrics, out)
    if found.status == "poor":
        print_warnings([f"the result is poor: {'; '.join(found.warnings)}"])
    return 0 if found.status == "ok" else 1


def _metrics(found: SessionLocalisation, session: Path) -> dict[str, float | bool]:
    """What the truth says of it, where the session has one."""
    from cluster_slam.evaluation.localised import evaluate_localisation
    from cluster_slam.io.session import open_truth

    truth = open_truth(session, found.session)
    return {} if truth is None else evaluate_localisation(found, truth).as_json()


_WORDS = {  # of the summary; metrics.json has all
    "ate_rmse_m": "position error, RMS",
    "ate_rotation_rad": "orientation error, RMS",
    "within_1cm_1deg": "share within 1 cm, 1 degree",
    "nees_poses": "NEES / 6 (1 is true)",
    "cluster_idf1": "IDF1 of clusters",
    "flower_idf1": "IDF1 of flowers",
}


def _against_truth(metrics: dict[str, float | bool]) -> list[tuple[str, str]]:
    from cluster_slam.cli.summary import shown_metric

    return [(words, shown_metric(name, float(metrics[name]))) for name, words in _WORDS.items() if name in metrics]


def _tell(found: SessionLocalisation, metrics: dict[str, float | bool], out: Path) -> None:
    from cluster_slam.report.localised_page import sureness

    print_warnings(found.warnings if found.status == "ok" else ())
    n, located = found.session.n_frames, int(found.is_located.sum())
    lost = [(r, found.reasons.count(r)) for r in ("ambiguous", "too_few", "no_match")]
    rows = [
        ("session", found.session.id),
        ("frames", str(n)),
        ("located", f"{located} ({100 * located / n:.1f} %)"),
        ("lost", ", ".join(f"{count} {reason}" for reason, count in lost if count) or "none"),
    ]
    if located:
        turn, shift = sureness(found)
        rows.append(("sure to (one sigma, median)", f"{shift:.2f} mm, {turn:.3f} deg"))
    rows += _against_truth(metrics)
    print_table(f"cluster-slam localise: {found.status}", [*rows, ("result", str(out))])
