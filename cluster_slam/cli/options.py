"""Options that several commands share, and how a configuration is put together from file and command line."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from cluster_slam.config import override
from cluster_slam.errors import ConfigError

C = TypeVar("C")

SessionArgument = Annotated[Path, typer.Argument(metavar="SESSION", help="Session folder.", show_default=False)]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE.toml", help="Options of the method, as TOML.", show_default=False),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="One option of the method; may be repeated.", show_default=False),
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Seed of all that is random.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON on stdout, and nothing else.")]


def configured(default: C, file: Path | None, settings: Sequence[str]) -> C:
    """A configuration (a dataclass) with the options of a TOML file, then those of ``key=value`` settings.

    Raises
    ------
    ConfigError
        An unknown key, a value of the wrong type, or no TOML.
    """
    config = default
    if file is not None:
        content = _read(file)
        try:
            config = override(config, content)
            _check_types(config)
        except ConfigError as error:
            raise ConfigError(f"{file}: {error}") from None
    for setting in settings:
        config = override(config, _nested(setting))
    _check_types(config)
    return config


def _read(file: Path) -> dict[str, Any]:
    from cluster_slam.io.text import read_text

    try:
        return tomllib.loads(read_text(file, "options as TOML"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{file}: {error}, expected TOML") from None


def _nested(setting: str) -> dict[str, Any]:
    """``a.b=1`` as ``{"a": {"b": 1}}``; a value that is no TOML is a word."""
    key, equals, text = setting.partition("=")
    if not (equals and key.strip()):
        raise ConfigError(f"--set {setting!r}, expected KEY=VALUE, as in --set max_rounds=5")
    try:
        value: Any = tomllib.loads(f"value = {text.strip()}")["value"]
    except (tomllib.TOMLDecodeError, KeyError):
        value = text.strip()
    for part in reversed(key.strip().split(".")):
        value = {part: value}
    nested: dict[str, Any] = value
    return nested


def _check_types(config: Any) -> None:
    """Refuse values that are not of the declared type (``Literal`` choices, optional numbers)."""
    from pydantic import TypeAdapter, ValidationError

    try:
        TypeAdapter(type(config)).validate_python(asdict(config))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"])
        expected = first["msg"].removeprefix("Input should be ")
        raise ConfigError(f"option {name} is {first['input']!r}, expected {expected}") from None
