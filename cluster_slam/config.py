"""All options of the methods on one page: default, unit and reason. TOML overrides them; unknown keys are errors."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Literal, TypeVar

from cluster_slam.errors import ConfigError

GroupingMethod = Literal["spacing", "kmeans", "branch", "none"]


@dataclass(frozen=True, slots=True)
class GroupingConfig:
    """How flowers become clusters."""

    method: GroupingMethod = "spacing"  # average linkage on distance and common motion
    n_clusters: int | None = None  # for "kmeans"
    linkage_m: float | None = None  # cut of the linkage; None: from the gap in the spacing of the flowers


@dataclass(frozen=True, slots=True)
class SmoothConfig:
    """Options of ``smooth``."""

    gate_probability: float = 0.99  # share of true matches that a gate lets through
    grouping: GroupingConfig = field(default_factory=GroupingConfig)
    max_rounds: int = 3  # associate, smooth, associate again: at most so often


C = TypeVar("C")


def override(config: C, values: Mapping[str, Any], where: str = "") -> C:
    """A copy of the configuration with the values of a (nested) mapping, as TOML gives it.

    Raises
    ------
    ConfigError
        An unknown key (with the nearest known one) or a value of the wrong type.
    """
    known = {f.name: f for f in fields(config)}  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{where}{key}"
        if key not in known:
            near = difflib.get_close_matches(key, list(known), 1)
            hint = f"; did you mean {where}{near[0]}?" if near else f"; known: {', '.join(sorted(known))}"
            raise ConfigError(f"unknown option {name}{hint}")
        current = getattr(config, key)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(f"option {name} wants a table, not {value!r}")
            changes[key] = override(current, value, f"{name}.")
        else:
            changes[key] = _checked(name, current, value)
    return replace(config, **changes)  # type: ignore[type-var]


def _checked(name: str, current: Any, value: Any) -> Any:
    if isinstance(current, bool) or isinstance(value, bool):
        if not (isinstance(value, bool) and isinstance(current, bool)):
            raise ConfigError(f"option {name} wants {type(current).__name__}, not {value!r}")
        return value
    if isinstance(current, float) and isinstance(value, int):
        return float(value)
    if current is not None and value is not None and not isinstance(value, type(current)):
        raise ConfigError(f"option {name} wants {type(current).__name__}, not {value!r}")
    return value
