"""What an experiment is: a task, what is fixed, what is swept, and the seeds; read from TOML."""

from __future__ import annotations

import difflib
import hashlib
import itertools
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from cluster_slam.config import LocaliseConfig, MapConfig, OnlineConfig, SmoothConfig, override
from cluster_slam.errors import ConfigError, InputError
from cluster_slam.io.text import read_text
from cluster_slam.simulate import PRESETS, SimulateConfig
from cluster_slam.simulate.season import SeasonConfig

Value = str | float | int | bool
TASKS = ("localise", "smooth", "track", "reidentify")
METHODS: dict[str, Any] = {
    "localise": LocaliseConfig,
    "smooth": SmoothConfig,
    "track": OnlineConfig,
    "reidentify": MapConfig,
}
TASK_OPTIONS: dict[str, dict[str, Value]] = {
    "localise": {
        "independent": False,  # every frame kidnapped
        "window": 0,  # frames; 0: all before
        "map_age_days": 0.0,  # since the map was made
        "map_drift_m_per_day": 0.003,  # RMS norm, of each cluster since then
        "wrong_map": False,  # of another plant
    },
    "smooth": {},
    "track": {"with_calibration": True},
    "reidentify": {},
}


@dataclass(frozen=True, slots=True)
class Cell:
    """One point of the sweep with one seed."""

    task: str
    preset: str
    options: tuple[tuple[str, Value], ...]  # all, fixed and swept, by name
    swept: tuple[tuple[str, Value], ...]
    seed: int

    @property
    def key(self) -> str:
        """What names the cell, the same in any process."""
        return json.dumps([self.task, self.preset, self.options, self.seed])


@dataclass(frozen=True, slots=True)
class Experiment:
    """A whole experiment."""

    name: str
    task: str
    preset: str
    seeds: tuple[int, ...]
    fixed: tuple[tuple[str, Value], ...]
    sweep: tuple[tuple[str, tuple[Value, ...]], ...]

    @property
    def cells(self) -> list[Cell]:
        """All cells, in the order of the table."""
        names = [name for name, _ in self.sweep]
        points = itertools.product(*(values for _, values in self.sweep))
        out = []
        for point in points:
            swept = tuple(zip(names, point, strict=True))
            options = tuple(sorted({**dict(self.fixed), **dict(swept)}.items()))
            out += [Cell(self.task, self.preset, options, swept, seed) for seed in self.seeds]
        return out

    @property
    def digest(self) -> str:
        """Tells one experiment from another."""
        return hashlib.sha256(json.dumps([c.key for c in self.cells]).encode()).hexdigest()


def read_experiment(path: Path) -> Experiment:
    """An experiment from its TOML file, every option checked before anything runs.

    Raises
    ------
    InputError
        The file is missing or no TOML, or a table or value is not what was expected.
    ConfigError
        An option is unknown (with the nearest known one) or out of its range.
    """
    try:
        content = tomllib.loads(read_text(path, "an experiment as TOML"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: {error}, expected TOML") from None
    _only(path, content, ("name", "task", "preset", "seeds", "fixed", "sweep"))
    task = content.get("task")
    if task not in TASKS:
        raise InputError(f"{path}: task is {task!r}, expected one of {', '.join(TASKS)}")
    preset = content.get("preset", "moderate")
    if preset not in PRESETS:
        near = difflib.get_close_matches(str(preset), PRESETS, 1)
        raise InputError(f"{path}: unknown preset {preset!r}" + (f"; did you mean {near[0]}?" if near else ""))
    sweep = _table(path, content, "sweep")
    for name, values in sweep.items():
        if not isinstance(values, list) or not values:
            raise InputError(f"{path}: sweep.{name} is {values!r}, expected a list of values")
    experiment = Experiment(
        name=str(content.get("name", path.stem)),
        task=task,
        preset=preset,
        seeds=_seeds(path, content.get("seeds", 10)),
        fixed=tuple(sorted(_flat(_table(path, content, "fixed")).items())),
        sweep=tuple((name, tuple(values)) for name, values in sweep.items()),
    )
    for cell in experiment.cells:
        if cell.seed == experiment.seeds[0]:
            resolve(cell)
    return experiment


def _only(path: Path, content: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in content:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
            raise InputError(f"{path}: unknown key {key!r}; {hint}")


def _table(path: Path, content: Mapping[str, Any], name: str) -> dict[str, Any]:
    value = content.get(name, {})
    if not isinstance(value, dict):
        raise InputError(f"{path}: {name} is {value!r}, expected a table")
    return value if name == "fixed" else _flat(value)


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables by dotted names."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        out |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return out


def _seeds(path: Path, given: Any) -> tuple[int, ...]:
    seeds = list(range(given)) if isinstance(given, int) and not isinstance(given, bool) else given
    whole = isinstance(seeds, list) and all(isinstance(s, int) and not isinstance(s, bool) and s >= 0 for s in seeds)
    if not whole or not seeds or len(set(seeds)) < len(seeds):
        raise InputError(f"{path}: seeds is {given!r}, expected a number of seeds or a list of different ones from 0")
    return tuple(seeds)


@dataclass(frozen=True, slots=True)
class Resolved:
    """A cell's options, sorted out."""

    simulate: SimulateConfig
    season: SeasonConfig
    method: Any
    task: dict[str, Value]


def resolve(cell: Cell) -> Resolved:
    """Whose option each is: the world's, the season's (``season.``), the method's (``config.``), or the task's own.

    Raises
    ------
    ConfigError
        An option is unknown or out of its range.
    """
    world: dict[str, Any] = {}
    season: dict[str, Any] = {}
    method: dict[str, Any] = {}
    task = dict(TASK_OPTIONS[cell.task])
    worlds = {f.name for f in fields(SimulateConfig)}
    for name, value in cell.options:
        if name.startswith("config."):
            _put(method, name.removeprefix("config.").split("."), value)
        elif name.startswith("season.") and cell.task == "reidentify":
            season[name.removeprefix("season.")] = value
        elif name in task:
            task[name] = value
        elif name in worlds:
            world[name] = value
        else:
            near = difflib.get_close_matches(name, [*worlds, *task], 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ConfigError(f"unknown option {name!r} of {cell.task}{hint}; those of the method begin with config.")
    simulated = override(PRESETS[cell.preset], world)
    return Resolved(
        simulated, override(SeasonConfig(session=simulated), season), override(METHODS[cell.task](), method), task
    )


def _put(table: dict[str, Any], path: list[str], value: Any) -> None:
    for part in path[:-1]:
        table = table.setdefault(part, {})
    table[path[-1]] = value
