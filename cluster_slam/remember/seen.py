"""How much of a plant a session sees, learned from what came back, what did not, and what nobody knew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.growth import DAY_S, gaps
from cluster_slam.geometry import Array
from cluster_slam.records import PlantMap
from cluster_slam.remember.history import History, hidden_looks, history_of

PRIOR_LOOKS = 10.0  # the prior share of flowers that a session sees counts as so many looks
PRIOR_SURPRISES = 5.0  # flowers that nobody knew: what is expected of them counts as so many
N_ROUNDS = 12  # of expectation maximisation
SHAPES = (1.0, 50.0)  # of the gamma distribution of clusters' sizes: from any size to all alike


@dataclass(frozen=True, slots=True)
class Habits:
    """What sessions of a plant see, and what that is known from."""

    share: float  # of the flowers that are there
    looks: float  # flowers, prior ones too, that tell the share
    at_once: float  # times as many hidden and false flowers as expected nobody knew ...
    since: float  # ... and as many new ones
    surprises: float  # flowers, prior ones too, that tell that


def habits_of(plant: PlantMap, config: MapConfig) -> Habits:
    """What a session of the plant sees, as far as is known."""
    history = history_of(plant)
    share, looks = learned_seen_share(plant, history, config)
    return Habits(share, looks, *_surprise(history, share, config))


def learned_seen_share(plant: PlantMap, history: History, config: MapConfig) -> tuple[float, float]:
    """Share of the flowers that a session sees, and how many looks tell: at flowers beside which others were seen.

    One that was seen again later was there in between. One that did not come back was hidden each time, or lost, or
    false from the beginning (expectation maximisation).
    """
    sessions, prior = np.arange(len(history.days)), config.match.seen_share
    there = history.beside & (sessions > history.first[:, None]) & (sessions <= history.last[:, None])
    hits = float((there & history.seen).sum())
    missed = float((there & ~history.seen).sum())
    real, share, hidden = is_real(plant, config.match.ghosts), prior, 0.0
    for _ in range(N_ROUNDS):
        hidden = missed + float(hidden_looks(history, real, share, config.growth.lost_per_day).sum())
        share = min((PRIOR_LOOKS * prior + hits) / (PRIOR_LOOKS + hits + hidden), 0.999)
    return share, PRIOR_LOOKS + hits + hidden


def is_real(plant: PlantMap, ghosts: float) -> Array:
    """Probability (f,) that a flower is one: of those seen once, so many beside each cluster are false."""
    once = plant.flower_first_seen == plant.flower_last_seen
    n = np.bincount(plant.flower_rows, minlength=len(plant.cluster_ids))[plant.flower_rows]
    return np.where(once, n / (n + ghosts), 1.0)


def unknown_flowers(plant: PlantMap, seen: Array, habits: Habits, time: float, config: MapConfig) -> Array:
    """Mean number (c,) of flowers beside a cluster's known ones that will be seen: hidden so far, new, or false.

    ``seen`` (c,) of the known ones will be.
    """
    looks: Array = np.where(plant.cluster_last_seen > plant.cluster_first_seen, 2.0, 1.0)
    days = np.abs(gaps(plant, time)) / DAY_S
    at_once = _hidden(seen, looks, habits.share) + config.match.ghosts
    unknown: Array = habits.at_once * at_once + habits.since * seen * config.growth.new_per_day * days
    return unknown


def _hidden(seen: Array, looks: Array, share: float) -> Array:
    """Mean number (c,) of flowers that some looks missed and the next one sees.

    A cluster of few known flowers has more hidden ones than its share: sizes are Poisson of a rate that is gamma
    distributed over the plant, shape r and mean m by their moments, so that with k seen of a part 1 - h that shows,
    h (k + r) / (1 - h + r / m) are hidden.
    """
    h = (1.0 - share) ** looks
    sizes = seen / np.maximum(share * (1.0 - h), 1e-3)
    mean = max(float(sizes.mean()), 1e-3) if len(sizes) else 1.0
    shape = float(np.clip(mean**2 / max(float(sizes.var()) - mean, 1e-3), *SHAPES)) if len(sizes) else SHAPES[1]
    hidden: Array = h * (seen + share * shape) / (1.0 - h + shape / mean)
    return hidden


def _surprise(history: History, share: float, config: MapConfig) -> tuple[float, float, float]:
    """Factors of what nobody knew of a cluster before a session, at once and since, and how many flowers tell.

    Flowers that were hidden or are false come with a look, new ones with time. Which of them one was cannot be told:
    each counts for both, by what is expected of them (expectation maximisation).
    """
    is_seen, newcomers = history.counts > 0, history.newcomers
    looks = np.cumsum(is_seen, axis=1)
    cluster, session = np.nonzero(is_seen & (looks > 1))
    latest = np.maximum.accumulate(np.where(is_seen, np.arange(len(history.days)), 0), axis=1)
    days = history.days[session] - history.days[latest[cluster, session - 1]]
    found = float(newcomers[cluster, session].sum())
    seen: Array = np.asarray(history.counts - newcomers, dtype=np.float64)[cluster, session]
    so_far: Array = np.minimum(looks[cluster, session] - 1.0, 2.0)
    at_once = float((_hidden(seen, so_far, share) + config.match.ghosts).sum())
    since = float((seen * config.growth.new_per_day * days).sum())
    a = b = 1.0
    for _ in range(N_ROUNDS):
        part = a * at_once / max(a * at_once + b * since, 1e-12)
        a = (PRIOR_SURPRISES + part * found) / (PRIOR_SURPRISES + at_once)
        b = (PRIOR_SURPRISES + (1.0 - part) * found) / (PRIOR_SURPRISES + since)
    return a, b, PRIOR_SURPRISES + found


def scattered(plant: PlantMap, spread: Array) -> float:
    """Variance of the places of flowers that nobody knew over what is expected, as learned from those that came.

    One of a cluster of variance ``spread`` (c,) lies spread (1 + 1 / n) from the middle of n others, along each axis.
    """
    order = np.lexsort((plant.flower_first_seen, plant.flower_rows))
    row, time, place = plant.flower_rows[order], plant.flower_first_seen[order], plant.flowers[order]
    begin = np.searchsorted(row, row)  # of the cluster, and of the flowers that came with this one
    with_it = np.append(True, (np.diff(row) > 0) | (np.diff(time) > 0))
    came = np.maximum.accumulate(np.where(with_it, np.arange(len(row)), 0))
    later = np.flatnonzero(came > begin)
    before = (came - begin)[later]
    total = np.vstack([np.zeros(3), np.cumsum(place, axis=0)])
    middle = (total[came[later]] - total[begin[later]]) / before[:, None]
    squared = ((place[later] - middle) ** 2).sum(axis=1) / 3.0
    expected = np.maximum(spread[row[later]] * (1.0 + 1.0 / before), 1e-12)
    return (PRIOR_SURPRISES + float((squared / expected).sum())) / (PRIOR_SURPRISES + len(later))
