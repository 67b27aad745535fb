"""``run.json`` of a result, read back and checked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from cluster_slam.errors import InputError
from cluster_slam.io.text import read_text, shown


class RunRecord(BaseModel):
    """What a run said about itself; parts that other writers leave out have defaults."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    command: str = "smooth"
    session: str | None = None
    session_path: Path | None = None
    level: int | None = None
    config: dict[str, Any] = {}
    seed: int | None = 0
    timings_s: dict[str, float] = {}
    counts: dict[str, int] = {}
    estimated_noise: dict[str, float] = {}
    warnings: tuple[str, ...] = ()
    merged: tuple[tuple[int, int], ...] = ()
    status: Literal["ok", "poor"] = "ok"


def read_run(path: Path) -> RunRecord:
    """The record of a run.

    Raises
    ------
    InputError
        The file is missing, no JSON, or a value is of another type.
    """
    text = read_text(path, "the record of a run (is this a result folder?)")
    try:
        return RunRecord.model_validate(json.loads(text))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: row {error.lineno}: {error.msg}, expected JSON") from None
    except RecursionError:
        raise InputError(f"{path}: nested too deeply, expected the record of a run") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"]) or "the whole"
        expected = first["msg"].removeprefix("Input should be ")
        raise InputError(f"{path}: {name} is {shown(first['input'])}, expected {expected}") from None
