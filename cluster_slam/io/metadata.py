"""``session.toml``: what a recording says about itself."""

from __future__ import annotations

import difflib
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cluster_slam.errors import InputError
from cluster_slam.io.tables import NORM_TOLERANCE
from cluster_slam.io.text import read_text, shown

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Sigma = Annotated[float, Field(gt=0.0, lt=1e6, allow_inf_nan=False, strict=True)]
Transform = Annotated[list[Number], Field(min_length=7, max_length=7)]
_OPEN = ConfigDict(extra="allow", frozen=True)


class Frames(BaseModel):
    """``[frames]``: what the poses are."""

    model_config = _OPEN
    pose: Literal["T_world_camera", "T_world_flange"]
    pose_error: Literal["absolute", "odometry"] = "absolute"
    T_flange_camera: Transform | None = None
    max_time_difference: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.02


class Depth(BaseModel):
    """``[depth]``: what a depth is."""

    model_config = _OPEN
    scale: Sigma = 0.001
    convention: Literal["z", "ray"] = "z"
    camera: Literal["generic", "d405", "d435"] | None = None


class Noise(BaseModel):
    """``[noise]``: one sigma each; the defaults are those of :class:`cluster_slam.records.StatedNoise`."""

    model_config = _OPEN
    pose_translation: Sigma | None = None
    pose_rotation: Sigma | None = None
    odometry_translation: Sigma | None = None
    odometry_rotation: Sigma | None = None
    hand_eye_translation: Sigma | None = None
    hand_eye_rotation: Sigma | None = None
    flower: Sigma | None = None
    pixel: Sigma | None = None
    depth: Sigma | None = None


class TruthTable(BaseModel):
    """``[truth]``: only where truth is known."""

    model_config = _OPEN
    T_map_world: Transform | None = None


class Metadata(BaseModel):
    """The whole of ``session.toml``."""

    model_config = _OPEN
    format: Literal[1]
    id: Annotated[str, Field(min_length=1, strict=True)]
    plant: str | None = None
    frames: Frames
    depth: Depth = Depth()
    noise: Noise = Noise()
    truth: TruthTable = TruthTable()


def read_metadata(path: Path) -> tuple[Metadata, tuple[str, ...]]:
    """The metadata of a session, and warnings about keys that nobody knows.

    Raises
    ------
    InputError
        The file is missing, no TOML, of another format, or a value is not what the format says.
    """
    text = read_text(path, "session.toml (is this a session folder?)")
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        row = re.search(r"at line (\d+)", str(error))
        where = row.group(1) if row else text.count("\n") + 1
        raise InputError(f"{path}: row {where}: {error}, expected TOML") from None
    try:
        metadata = Metadata.model_validate(raw)
    except ValidationError as error:
        raise _refusal(path, text, error) from None
    _check_transforms(path, text, metadata)
    return metadata, tuple(_unknown(path, text, metadata, ""))


def _refusal(path: Path, text: str, error: ValidationError) -> InputError:
    first = error.errors(include_url=False)[0]
    keys = [str(part) for part in first["loc"]]
    if first["type"] == "missing":
        return InputError(f"{path}: row {_row(text, keys[:-1])}: no {'.'.join(keys)}, expected one")
    value = "a table" if isinstance(first["input"], dict) else shown(first["input"])
    expected = first["msg"].removeprefix("Input should be ")
    return InputError(f"{path}: row {_row(text, keys)}: {'.'.join(keys)} is {value}, expected {expected}")


def _row(text: str, keys: list[str]) -> int:
    """The row where a key is set, or its table begins; 1 where that cannot be said."""
    lines = text.split("\n")
    begin = 0
    for key in keys:
        pattern = re.compile(rf"\s*(\[{re.escape(key)}\]|[\"']?{re.escape(key)}[\"']?\s*=)")
        begin = next((i for i in range(begin, len(lines)) if pattern.match(lines[i])), begin)
    return begin + 1


def _check_transforms(path: Path, text: str, metadata: Metadata) -> None:
    if metadata.frames.pose == "T_world_flange" and metadata.frames.T_flange_camera is None:
        row = _row(text, ["frames", "pose"])
        raise InputError(f"{path}: row {row}: frames.pose is T_world_flange, expected frames.T_flange_camera beside it")
    transforms = (
        ("frames", "T_flange_camera", metadata.frames.T_flange_camera),
        ("truth", "T_map_world", metadata.truth.T_map_world),
    )
    for table, key, value in transforms:
        norm = sum(q * q for q in value[3:]) ** 0.5 if value else 1.0
        if abs(norm - 1.0) > NORM_TOLERANCE:
            row = _row(text, [table, key])
            raise InputError(f"{path}: row {row}: {table}.{key} has a quaternion of norm {norm:.6g}, expected 1")


def _unknown(path: Path, text: str, model: BaseModel, where: str) -> list[str]:
    found: list[str] = []
    known = list(type(model).model_fields)
    for key in model.model_extra or {}:
        near = difflib.get_close_matches(key, known, 1)
        hint = f"; is it {where}{near[0]}?" if near else ""
        row = _row(text, [*filter(None, where.split(".")), key])
        found.append(f"{path}: row {row}: unknown key {where}{key} is ignored{hint}")
    for key in known:
        value: Any = getattr(model, key)
        if isinstance(value, BaseModel):
            found += _unknown(path, text, value, f"{where}{key}.")
    return found
