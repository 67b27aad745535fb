"""``cluster-slam detect``: flowers in the pictures of a session, or of any folder."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings

if TYPE_CHECKING:
    from cluster_slam.io.observed import Detector

ModelOption = Annotated[
    Path | None,
    typer.Option("--model", metavar="M.onnx", help="Detector for pictures; default: our own.", show_default=False),
]
DetectorOption = Annotated[
    str | None,
    typer.Option("--detector", metavar="NAME", help="own, or colour (needs no model).", show_default=False),
]
PromptOption = Annotated[str, typer.Option("--prompt", metavar="TEXT", help="What a Grounding DINO model looks for.")]


def command(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Session folder, or a folder of images.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="OUT", help="Folder for detections.csv; an earlier one is replaced.")
    ],
    model: ModelOption = None,
    detector: DetectorOption = None,
    prompt: PromptOption = "flower .",
    score: Annotated[
        float | None, typer.Option("--score", min=0.0, max=1.0, help="Least score.", show_default=False)
    ] = None,
    provider: Annotated[
        str, typer.Option("--provider", metavar="NAME", help="Execution provider of onnxruntime: cpu, cuda, ...")
    ] = "cpu",
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of one picture.")] = 1,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Find flowers in pictures.

    Of a session, detections.csv has timestamps and depths, as a session of level 2 wants them; of a folder of images it
    has the image's name in place of the timestamp.

    Example: cluster-slam detect session -o out/detections
    """
    from cluster_slam.io.detection_writer import check_detections_output, detect_images, detect_session

    check_detections_output(out)
    finder = open_named(model, detector, prompt=prompt, score=score, provider=provider, threads=threads)
    started = perf_counter()
    work = detect_session if (source / "session.toml").exists() else detect_images
    with StageProgress(is_shown=not (quiet or as_json)) as progress:
        done = work(source, out, finder, progress)
    facts: dict[str, Any] = {**done.counts, "time_s": round(perf_counter() - started, 3), "out": str(out)}
    if as_json:
        print_json({**facts, "warnings": list(done.warnings)})
    elif not quiet:
        print_warnings(done.warnings)
        print_table("cluster-slam detect", [(name.replace("_", " "), str(value)) for name, value in facts.items()])
    return 0


def open_named(
    model: Path | None,
    detector: str | None,
    *,
    prompt: str = "flower .",
    score: float | None = None,
    provider: str = "cpu",
    threads: int = 1,
) -> Detector:
    """The detector that the options name: a model's file, ``own`` (the default) or ``colour``.

    Raises
    ------
    ConfigError
        Both or an unknown one are named.
    InputError
        The model cannot be used.
    """
    from cluster_slam.detect import open_detector

    return open_detector(model, name=detector, prompt=prompt, score=score, provider=provider, threads=threads)


def detector_for(session: Path, level: int | None, model: Path | None, detector: str | None) -> Detector | None:
    """The detector for a session that starts at pictures; None for one that does not.

    Raises
    ------
    ConfigError
        A detector is named for a session that needs none.
    """
    from cluster_slam.errors import ConfigError
    from cluster_slam.io.session import session_level

    named = model is not None or detector is not None
    used = session_level(session, 1 if named and level is None and (session / "rgb.txt").exists() else level)
    if used == 1:
        return open_named(model, detector)
    if named:
        raise ConfigError(f"{session}: starts at level {used}, expected no detector (or --level 1)")
    return None
