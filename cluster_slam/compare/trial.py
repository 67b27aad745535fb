"""One row of the table: all descriptors on one case."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from cluster_slam.compare.bound import TrueRatio
from cluster_slam.compare.contenders import BOUND, Contender, Scores
from cluster_slam.compare.population import Case, Pairs, Population, all_pairs, observe
from cluster_slam.compare.statistics import equal_error_rate, false_match_rate, rank_1, roc
from cluster_slam.geometry import Array

PROBABILITY = 0.95


@dataclass(frozen=True, slots=True)
class Size:
    """How many pairs a row rests on."""

    n_gallery: int = 100  # clusters, each observed once and held against all
    n_genuine: int = 1500  # further true pairs
    n_bound: int = 4000  # false pairs that the bound rests on
    max_bound_sigma_m: float = 0.005  # above it the bound's integral over the rotation is not trusted


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What one descriptor reached in one case."""

    case: Case
    name: str
    false_match_rate: float  # at 95 % recall
    equal_error_rate: float
    rank_1: float  # in a gallery of n_gallery clusters
    coverage: float  # of a nominal 95 % gate
    us_per_pair: float  # time of a comparison, descriptions included
    roc: tuple[Array, Array]  # false match rate and recall


def run_case(case: Case, competitors: tuple[Contender, ...], size: Size, *, rng: np.random.Generator) -> list[Outcome]:
    """All descriptors on the same pairs."""
    population = Population(case.radius_m)
    gallery = observe(case, population.draw(case.n_flowers, size.n_gallery, rng=rng), rng=rng)
    genuine = observe(case, population.draw(case.n_flowers, size.n_genuine, rng=rng), rng=rng)
    out = []
    for contender in competitors:
        out += _outcomes(case, contender, gallery, genuine)
    if not case.n_missing and not case.n_new and case.sigma_m <= size.max_bound_sigma_m:
        out.append(_bound(case, population, gallery, genuine, size, rng=rng))
    return out


def _bound(
    case: Case, population: Population, gallery: Pairs, genuine: Pairs, size: Size, *, rng: np.random.Generator
) -> Outcome:
    """What the true likelihood ratio reaches; it has no gate, and no time that matters."""
    ratio = TrueRatio(population, case.n_flowers, case.sigma_m, rng=rng)
    i, j = all_pairs(len(gallery.reference))
    false = np.flatnonzero(i != j)
    some = np.sort(rng.choice(false, min(size.n_bound, len(false)), replace=False))
    own = np.arange(len(genuine.reference))
    true, impostor = -ratio(genuine, own, own), -ratio(gallery, i[some], j[some])
    rates = false_match_rate(true, impostor), equal_error_rate(true, impostor)
    return Outcome(case, BOUND, *rates, np.nan, np.nan, np.nan, roc(true, impostor))


def _outcomes(case: Case, contender: Contender, gallery: Pairs, genuine: Pairs) -> list[Outcome]:
    n, common = len(gallery.reference), case.n_flowers - case.n_missing
    i, j = all_pairs(n)
    start = perf_counter()
    table = contender.score(gallery, case.sigma_m, common, i, j)
    us_per_pair = 1e6 * (perf_counter() - start) / len(i)
    own = np.arange(len(genuine.reference))
    true = contender.score(genuine, case.sigma_m, common, own, own)
    rows = zip(contender.names, table, true, strict=True)
    return [_outcome(case, name, one, two, n, us_per_pair) for name, one, two in rows]


def _outcome(case: Case, name: str, table: Scores, true: Scores, n: int, us_per_pair: float) -> Outcome:
    square = table.statistic.reshape(n, n)
    impostor = square[~np.eye(n, dtype=bool)]
    genuine = np.concatenate([true.statistic, np.diagonal(square)])
    return Outcome(
        case,
        name,
        false_match_rate(genuine, impostor),
        equal_error_rate(genuine, impostor),
        rank_1(square),
        true.coverage(PROBABILITY),
        us_per_pair,
        roc(genuine, impostor),
    )
