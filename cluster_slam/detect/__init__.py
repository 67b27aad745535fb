"""Detectors: flowers in a colour picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cluster_slam.detect.colour import ColourDetector
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.io.observed import Detector

__all__ = ["ColourDetector", "open_detector"]
NAMES = ("own", "colour")


def open_detector(
    model: str | Path | None = None,
    *,
    name: str | None = None,
    prompt: str = "flower .",
    score: float | None = None,
    provider: str = "cpu",
    threads: int = 1,
) -> Detector:
    """A detector: that of a model's file, or one by its name.

    Parameters
    ----------
    model
        An ONNX file.
    name
        ``own`` (the default without a model): the small detector that comes with the package; ``colour``: bright pale
        blobs.
    prompt
        What a model that takes a text looks for, each phrase ended by a full stop.
    score
        Least score; None: what the kind of model is used with.
    provider
        Execution provider of onnxruntime: cpu, cuda, ...
    threads
        Threads of one picture.

    Raises
    ------
    ConfigError
        Both a model and a name, or an unknown name or provider.
    InputError
        The model cannot be used.
    """
    if model is not None and name is not None:
        raise ConfigError(f"model {model} and detector {name!r}, expected one of them")
    if model is None and name not in (None, *NAMES):
        raise ConfigError(f"unknown detector {name!r} (known: {', '.join(NAMES)}, or a model's file)")
    if name == "colour":
        return ColourDetector() if score is None else ColourDetector(min_score=score)
    from cluster_slam.detect.onnx import open_onnx, own_model

    path = own_model() if model is None else Path(model)
    return open_onnx(path, prompt=prompt, score=score, provider=provider, threads=threads)
