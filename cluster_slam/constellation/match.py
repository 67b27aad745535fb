"""A session's constellation against a plant's with nothing known of the pose: what fits, how well, what else fits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.config import GrowthConfig, MatchConfig
from cluster_slam.constellation.evidence import is_too_few
from cluster_slam.constellation.explain import Explained, Scene, explain, matched_pairs, robust
from cluster_slam.constellation.fit import Pairs, fit, variance_factors
from cluster_slam.constellation.plane import Space
from cluster_slam.constellation.search import Candidate, candidates_of, still_there
from cluster_slam.constellation.similarity import Similarities
from cluster_slam.constellation.units import MATCH_FLOOR_M
from cluster_slam.constellation.warp import warped
from cluster_slam.geometry import Array
from cluster_slam.records import Constellation, PlantMap

DEEPER, DEEP_UP_TO = 6, 250  # times as many triples are tried where nothing fits, in sessions of up to so many flowers
MAX_PRIOR = 3.0  # log odds that a cluster is known because the others are: at most so much
CLEARLY = 6.0  # log of a Bayes factor: the two counts of what is new are not alike to a few of them


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The best pose: p_map = T_map_world * (scale * p_world), and what it explains."""

    plant: PlantMap  # at the session's time, without the flowers that are long gone
    T_map_world: Array  # (4, 4)
    scale: float
    pairs: Pairs  # matched flowers, both where the session has them in its own world
    space: Space
    scene: Scene
    best: Explained
    single: bool  # flowers one by one, not cluster by cluster
    offset_factor: float  # variance of the units' drift over what was expected, by this session's residuals


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """How a session fits a plant."""

    name: str  # of the plant
    log_ratio: float  # log likelihood of the best pose over "another plant"
    evidence: float  # the same with all poses integrated out (Laplace): log of a Bayes factor
    runner_up: float  # evidence of the best pose that says something else
    is_repeated: bool  # the layout of the clusters fits in several ways
    found: Found | None = None


def match(
    session: Constellation,
    plant: PlantMap,
    config: MatchConfig | None = None,
    growth: GrowthConfig | None = None,
    *,
    similarity: bool = False,
) -> Match:
    """Match a session with a plant that has been moved to the session's time.

    Parameters
    ----------
    session
        What was seen.
    plant
        As :func:`cluster_slam.constellation.growth.at` gives it for the session's time.
    similarity
        Let the unit of length differ by a factor between ``config.scale_min`` and ``config.scale_max``.
    """
    config, growth = config or MatchConfig(), growth or GrowthConfig()
    alive = still_there(plant)
    candidates, repeated = candidates_of(session, alive, config, growth, similarity=similarity)
    best = max((c.evidence for c in candidates), default=-np.inf)
    if best < config.evidence and len(session.flowers) <= DEEP_UP_TO:
        deep = replace(config, n_seeds=DEEPER * config.n_seeds, max_poses=2 * config.max_poses)
        more, again = candidates_of(session, alive, deep, growth, similarity=similarity)
        candidates, repeated = candidates + more, repeated or again
    if not candidates:
        return Match(plant.name, 0.0, -np.inf, -np.inf, False)
    chosen = _best(candidates)
    others = [c.evidence for c in candidates if _says_something_else(chosen, c)]
    name, runner_up = plant.name, max(others, default=-np.inf)
    found = _found(session, alive, chosen)
    return Match(name, chosen.found.log_ratio, _evidence(candidates, chosen), runner_up, repeated, found)


def _best(candidates: list[Candidate]) -> Candidate:
    """The likeliest; of two that say the same, that of clusters, unless single flowers explain clearly more.

    What flowers of a cluster share is in the covariance of its pose, and in who is who.
    """
    best = max(candidates, key=lambda c: c.evidence)
    alike = [c for c in candidates if not c.single and c.evidence > best.evidence - CLEARLY]
    alike = [c for c in alike if not _says_something_else(best, c)] if best.single else []
    return max(alike, key=lambda c: c.evidence, default=best)


def _evidence(candidates: list[Candidate], chosen: Candidate) -> float:
    """Log of the Bayes factor of a pose: clusters drift as a whole or flowers one by one, nobody knows which."""
    alike = [c for c in candidates if not _says_something_else(chosen, c)]
    ways = {c.single for c in candidates}
    each = [max((c.evidence for c in alike if c.single == way), default=-np.inf) for way in sorted(ways)]
    return float(np.logaddexp.reduce(each) - np.log(len(each)))


def _says_something_else(best: Candidate, other: Candidate) -> bool:
    """Whether another explanation gives most flowers other partners."""
    mine, theirs = (_flower_pairs(c) for c in (best, other))
    return len(mine & theirs) < 0.5 * max(min(len(mine), len(theirs)), 1)


def _flower_pairs(candidate: Candidate) -> set[tuple[int, int]]:
    found, scene = candidate.found, candidate.scene
    row, member = np.nonzero(found.partner >= 0)
    a = scene.query.flower[found.query[row], member]
    b = scene.known.flower[found.known[row], found.partner[row, member]]
    return set(zip(a.tolist(), b.tolist(), strict=True))


def _with_prior(scene: Scene, found: Explained) -> tuple[Scene, Explained]:
    """The explanation again, now that the others say how many of the session's clusters the plant has.

    With m matched and u left over, the odds that one more is known are (m + 1) / (u + 1).
    """
    odds = np.log((len(found) + 1.0) / (len(scene.query) - len(found) + 1.0))
    scene = replace(scene, bonus=scene.bonus - np.clip(odds, 0.0, MAX_PRIOR))
    return scene, explain(scene, found.pose)[0]


def _found(session: Constellation, alive: PlantMap, best: Candidate) -> Found | None:
    scene, found = best.scene, best.found
    if best.single:
        scene, found = warped(scene, found)
    else:
        scene, found = _with_prior(scene, found)
    if is_too_few(found, best.space.d, single=best.single):
        return None
    row, member = np.nonzero(found.partner >= 0)
    a = session.flowers[scene.query.flower[found.query[row], member]]
    pairs, factor = _as_measured(matched_pairs(scene, found), found.pose)
    pose = found.pose if best.single else fit(pairs, scene.scale_range)  # a field has moved single ones to the session
    scale = float(pose.scale[0])
    T, pairs = best.space.to_map(pose.R[0], pose.t[0], scale), replace(pairs, a=a, b=a)
    return Found(alive, T, scale, pairs, best.space, scene, found, best.single, factor)


def _as_measured(pairs: Pairs, pose: Similarities) -> tuple[Pairs, float]:
    """Pairs with variances as their residuals have them, and the factor of the units' drift.

    The floor that makes matching patient is no error of the pose.
    """
    floor = MATCH_FLOOR_M**2
    variance, offset = np.maximum(pairs.variance - floor, 1e-9), np.maximum(pairs.var_offset - floor, 1e-9)
    pairs = replace(pairs, variance=variance, var_offset=offset)
    within, between = variance_factors(pairs, pose)
    return robust(replace(pairs, variance=within * variance, var_offset=between * offset), pose), between
