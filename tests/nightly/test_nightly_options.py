"""How flat results are around the default of each option: halved and doubled, one at a time, in a hard small world."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any

import pytest
from tables import Tables

from cluster_slam import evaluate, smooth
from cluster_slam.config import ParticleConfig, SmoothConfig, override
from cluster_slam.evaluation import Metrics
from cluster_slam.simulate import PRESETS, Simulated, simulate_session

pytestmark = pytest.mark.nightly
SEEDS = (701,)
PROBABILITIES = {"outlier_probability": (0.99, 0.9999)}  # what cannot be doubled


@cache
def world(seed: int) -> Simulated:
    """A hard world of a size that is smoothed in a few seconds."""
    return simulate_session(replace(PRESETS["hard"], n_clusters=14, n_leaves=9, duration_s=12.0), seed=seed)


def numbers(config: Any, name: str = "") -> list[tuple[str, float]]:
    """Names and defaults of all options that are numbers; those of other ways through the method are left out."""
    found = []
    for f in fields(config):
        value = getattr(config, f.name)
        if is_dataclass(value) and not isinstance(value, ParticleConfig):
            found += numbers(value, f"{name}{f.name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.append((f"{name}{f.name}", value))
    return found


def values() -> list[tuple[str, float]]:
    """Each option with half and with twice its default."""
    out: list[tuple[str, float]] = []
    for name, default in numbers(SmoothConfig()):
        half = max(1, default // 2) if isinstance(default, int) else 0.5 * default
        out += [(name, value) for value in PROBABILITIES.get(name, (half, 2 * default))]
    return out


def scores(config: SmoothConfig) -> list[Metrics]:
    """Of all seeds."""
    made = [world(seed) for seed in SEEDS]
    return [evaluate(smooth(m.session, config=config), m.session, m.truth) for m in made]


@cache
def default_scores() -> list[Metrics]:
    """At the defaults."""
    return scores(SmoothConfig())


@pytest.mark.parametrize(("name", "value"), values())
def test_results_are_flat_around_the_default(name: str, value: float, add_row: Tables) -> None:
    nested: dict[str, Any] = {}
    *path, last = name.split(".")
    at = nested
    for key in path:
        at = at.setdefault(key, {})
    at[last] = value
    found, usual = scores(override(SmoothConfig(), nested)), default_scores()
    row = {}
    for key in ("cluster_idf1", "flower_idf1", "clutter_recall"):
        row[key] = sum(float(getattr(m, key)) for m in found) / len(found)
        row[f"{key}_change"] = row[key] - sum(float(getattr(m, key)) for m in usual) / len(usual)
    add_row("options", option=name, value=value, **row)
    assert row["cluster_idf1_change"] > -0.02
    assert row["flower_idf1_change"] > -0.02
