"""The same questions to real flowers: six strawberry plants, labelled by hand in 3-D and seen by a detector."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster_slam.compare.contenders import Contender
from cluster_slam.compare.population import Pairs, all_pairs
from cluster_slam.compare.statistics import false_match_rate, rank_1
from cluster_slam.descriptors import isotropic, match_geometry
from cluster_slam.geometry import Array

PLANTS = range(1, 7)
LABEL_SIGMA_M = 0.003
DETECTOR_SIGMA_M = 0.0075  # the detector's root mean square error is 6.5 to 8.4 mm
MISSED_COST = 8.0  # of a flower without partner, in units of the squared distance
N_REPEATS = 20


@dataclass(frozen=True, slots=True)
class RealRow:
    """One descriptor on groups of neighbouring real flowers, errors simulated."""

    name: str
    n_flowers: int
    n_groups: int
    false_match_rate: float
    rank_1: float


@dataclass(frozen=True, slots=True)
class PlantRow:
    """What the real detector saw of one plant, held against the labels of all."""

    plant: int
    n_labels: int
    n_detections: int
    best_plant: int
    n_matched: int
    gain: float  # what matching saves, in units of the squared distance
    next_gain: float  # of the best other plant


def load_plants(folder: Path, kind: str) -> list[Array]:
    """Flowers (n, 3) of each plant; `kind` is labels, strict or lenient. Empty where the recordings are not there."""
    from cluster_slam.io.session import open_session

    paths = [folder / f"strawberry{plant}-{kind}" for plant in PLANTS]
    if not all(path.is_dir() for path in paths):
        return []
    return [open_session(path).observations.points for path in paths]


def neighbour_groups(plants: list[Array], n: int) -> Array:
    """Each flower with its n - 1 nearest (g, n, 3), every group once."""
    groups: dict[tuple[int, ...], Array] = {}
    for plant, flowers in enumerate(plants):
        if len(flowers) < n:
            continue
        gaps = np.linalg.norm(flowers[:, None] - flowers, axis=-1)
        for nearest in np.argsort(gaps, axis=1, kind="stable")[:, :n]:
            members = np.sort(nearest)
            groups[(plant, *members.tolist())] = flowers[members]
    return np.array(list(groups.values()))


def real_rows(
    plants: list[Array], n: int, competitors: tuple[Contender, ...], *, rng: np.random.Generator
) -> list[RealRow]:
    """All descriptors on all groups, both observations with the detector's error."""
    groups = neighbour_groups(plants, n)
    g = len(groups)
    i, j = all_pairs(g)
    own = np.arange(g)
    genuine: dict[str, list[Array]] = {}
    tables: dict[str, list[Array]] = {}
    for repeat in range(N_REPEATS):
        noisy = [groups + DETECTOR_SIGMA_M * rng.standard_normal(groups.shape) for _ in range(2)]
        pairs = Pairs(*noisy)
        for contender in competitors:
            true = contender.score(pairs, DETECTOR_SIGMA_M, n, own, own)
            for name, scores in zip(contender.names, true, strict=True):
                genuine.setdefault(name, []).append(scores.statistic)
            if repeat < 3:
                table = contender.score(pairs, DETECTOR_SIGMA_M, n, i, j)
                for name, scores in zip(contender.names, table, strict=True):
                    tables.setdefault(name, []).append(scores.statistic.reshape(g, g))
    return [_real_row(name, n, np.concatenate(genuine[name]), tables[name]) for name in tables]


def plant_rows(labels: list[Array], detected: list[Array]) -> list[PlantRow]:
    """Which plant's labels a detector's flowers fit best, false and missing ones included."""
    rows = []
    for k, seen in enumerate(detected):
        found = [_gain(flowers, seen) for flowers in labels]
        order = np.argsort([-gain for gain, _ in found], kind="stable")
        best, second = int(order[0]), int(order[1])
        rows.append(
            PlantRow(k + 1, len(labels[k]), len(seen), best + 1, found[best][1], found[best][0], found[second][0])
        )
    return rows


def _gain(flowers: Array, seen: Array) -> tuple[float, int]:
    cov, seen_cov = isotropic(len(flowers), LABEL_SIGMA_M), isotropic(len(seen), DETECTOR_SIGMA_M)
    match = match_geometry(flowers, cov, seen, seen_cov, missed_cost=MISSED_COST)
    n = len(match.reference)
    return (2 * n * MISSED_COST - match.distance_sq, n) if n else (0.0, 0)


def _real_row(name: str, n: int, genuine: Array, tables: list[Array]) -> RealRow:
    g = len(tables[0])
    impostor = np.concatenate([table[~np.eye(g, dtype=bool)] for table in tables])
    return RealRow(name, n, g, false_match_rate(genuine, impostor), float(np.mean([rank_1(t) for t in tables])))
