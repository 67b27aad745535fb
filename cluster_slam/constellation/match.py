"""A session's constellation against a plant's with nothing known of the pose: what fits, how well, what else fits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.config import GrowthConfig, MatchConfig
from cluster_slam.constellation.evidence import evidence_of, is_too_few
from cluster_slam.constellation.explain import Explained, Scene, explain, matched_pairs, n_flowers, refine, robust
from cluster_slam.constellation.fit import Pairs, fit, variance_factors
from cluster_slam.constellation.growth import DAY_S
from cluster_slam.constellation.plane import Space, spaces
from cluster_slam.constellation.poses import Places, best_distinct, guess_poses, quick_scores
from cluster_slam.constellation.similarity import Similarities, concatenate
from cluster_slam.constellation.units import MATCH_FLOOR_M, Units, background_of, plant_units, session_units
from cluster_slam.constellation.warp import warped
from cluster_slam.geometry import Array
from cluster_slam.records import Constellation, PlantMap

SINGLES_UP_TO = 80  # flowers on each side that are also matched one by one
N_REFINED = 6
N_TOGETHER = 3  # poses of single flowers that are looked at with clusters as units, too
MAX_PRIOR = 3.0  # log odds that a cluster is known because the others are: at most so much
GLANCE_SEEDS, GLANCE_POSES = 10, 300  # of a glance
LOOKS = 4000  # clusters that are looked at closely, over all poses: large plants need fewer poses to tell
CLEARLY = 6.0  # log of a Bayes factor: the two counts of what is new are not alike to a few of them
REPEATED_SHARE = 0.7  # of the centres: a second pose that puts so many on others means a repeated structure


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


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    space: Space
    scene: Scene
    found: Explained
    evidence: float
    single: bool


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
    alive = _alive(plant)
    candidates: list[_Candidate] = []
    repeated = False
    for space, single in _ways(session, alive):
        scene = _scene(session, alive, space, config, growth, single=single, similarity=similarity)
        if scene is None:
            continue
        explained, again = _search(scene)
        repeated |= again
        candidates += [_Candidate(space, scene, e, evidence_of(scene, e, single=single), single) for e in explained]
        by_clusters = _scene(session, alive, space, config, growth, single=False, similarity=similarity)
        if single and space.d == 3 and by_clusters is not None:  # in a plane two clusters were enough before
            candidates += _together(space, by_clusters, explained)
    if not candidates:
        return Match(plant.name, 0.0, -np.inf, -np.inf, False)
    best = _best(candidates)
    others = [c.evidence for c in candidates if _says_something_else(best, c)]
    name, runner_up = plant.name, max(others, default=-np.inf)
    found = _found(session, alive, best)
    return Match(name, best.found.log_ratio, best.evidence, runner_up, repeated, found)


def glance(session: Constellation, plant: PlantMap, config: MatchConfig, *, similarity: bool = False) -> float:
    """How well the centres alone agree under a few guessed poses: a score to rank many plants by, quickly."""
    alive = _alive(plant)
    best = 0.0
    for space, single in _ways(session, alive):
        scene = _scene(session, alive, space, config, GrowthConfig(), single=single, similarity=similarity)
        if scene is None:
            continue
        query, known = _places(scene.query, 0.002), _places(scene.known, 0.006)
        poses = guess_poses(query, known, scene.scale_range, GLANCE_SEEDS, GLANCE_POSES)
        if len(poses):
            best = max(best, float(quick_scores(poses, query, known, scene.background.log_group_density)[0].max()))
    return best


def _alive(plant: PlantMap) -> PlantMap:
    """Only the flowers that may still be there."""
    keep = plant.flower_presence > 0.02
    names = ("ids", "cluster_ids", "first_seen", "last_seen", "last_looked_at", "presence", "covs")
    values = {f"flower_{name}": getattr(plant, f"flower_{name}")[keep] for name in names}
    return replace(plant, flowers=plant.flowers[keep], **values)


def _ways(session: Constellation, plant: PlantMap) -> list[tuple[Space, bool]]:
    sigma = (
        float(np.sqrt(np.trace(session.flower_covs, axis1=1, axis2=2).mean() / 3.0)) if len(session.flowers) else 0.0
    )
    found = spaces(session.flowers, plant.flowers, sigma, session.viewpoint, plant.viewpoint)
    small = max(len(session.flowers), len(plant.flowers)) <= SINGLES_UP_TO
    return [(space, single) for space in found for single in ([False, True] if small else [False])]


def _scene(
    session: Constellation,
    plant: PlantMap,
    space: Space,
    config: MatchConfig,
    growth: GrowthConfig,
    *,
    single: bool,
    similarity: bool,
) -> Scene | None:
    """Both sides in one space; None where there are too few landmarks for a pose."""
    points, known = space.session(session.flowers), space.plant(plant.flowers)
    if min(len(points), len(known)) < space.d:
        return None
    groups = [session_units(session, points, single=False), plant_units(plant, known, config, single=False)]
    gap = session.start - plant.last_session
    days = 0.0 if np.isnan(gap) else abs(gap) / DAY_S
    n_new = config.ghosts + growth.new_per_day * days * len(known) / max(len(groups[1]), 1)
    background = background_of(groups[0], groups[1], config, n_new)
    scale_range = (config.scale_min, config.scale_max) if similarity else (1.0, 1.0)
    if not single:
        if min(len(g) for g in groups) < space.d:
            return None
        return Scene(groups[0], groups[1], background, np.zeros(len(groups[0])), config, scale_range)
    size = groups[0].groups.mask.sum(axis=1)
    per_flower = (background.log_group_density + (size - 1) * background.log_density) / size
    query = session_units(session, points, single=True)
    bonus = per_flower[query.cluster] - background.log_group_density
    return Scene(query, plant_units(plant, known, config, single=True), background, bonus, config, scale_range)


def _places(units: Units, jump: float) -> Places:
    """Centres with sigmas: drift, the flowers' own errors, and the jump of a centroid of changing flowers."""
    size = np.maximum(units.groups.mask.sum(axis=1), 1)
    own = np.where(units.groups.mask, units.groups.variances, 0.0).sum(axis=1) / size**2
    return Places(units.centres, np.sqrt(units.var_offset + own + jump**2 * (size > 1)))


def _search(scene: Scene) -> tuple[list[Explained], bool]:
    """The best explanations, refined, best first; and whether the layout of centres fits in several ways."""
    config = scene.config
    query, known = _places(scene.query, 0.002), _places(scene.known, 0.006)
    poses = guess_poses(query, known, scene.scale_range, config.n_seeds, config.max_poses)
    if not len(poses):
        return [], False
    scores, counts = quick_scores(poses, query, known, scene.background.log_group_density)
    spread = float(np.sqrt(((query.centres - query.centres.mean(0)) ** 2).sum(1).mean()))
    n_kept = int(np.clip(LOOKS / max(len(scene.query), 1), 6, config.n_kept))
    top = best_distinct(poses, scores, query.centres, 0.05 * spread, n_kept)
    n_least = min(len(query.centres), len(known.centres))
    far = best_distinct(poses.take(top), scores[top], query.centres, 0.3 * spread, 2)
    repeated = len(far) > 1 and bool((counts[top[far]] >= max(4, REPEATED_SHARE * n_least)).all())
    found = sorted(explain(scene, poses.take(top)), key=lambda e: -e.log_ratio)
    refined = [refine(scene, e) for e in found[: min(N_REFINED, n_kept // 3)]]
    return sorted(refined, key=lambda e: -e.log_ratio), repeated


def _together(space: Space, by_clusters: Scene, explained: list[Explained]) -> list[_Candidate]:
    """The likeliest poses of flowers one by one, with clusters as units: few in common place flowers, not centroids."""
    poses = [e.pose for e in explained[:N_TOGETHER] if n_flowers(e) >= 3]
    found = [refine(by_clusters, e) for e in explain(by_clusters, concatenate(poses))] if poses else []
    return [_Candidate(space, by_clusters, e, evidence_of(by_clusters, e, single=False), False) for e in found]


def _best(candidates: list[_Candidate]) -> _Candidate:
    """The likeliest; of two that say the same, that of clusters, unless single flowers explain clearly more.

    What flowers of a cluster share is in the covariance of its pose, and in who is who.
    """
    best = max(candidates, key=lambda c: c.evidence)
    alike = [c for c in candidates if not c.single and c.evidence > best.evidence - CLEARLY]
    alike = [c for c in alike if not _says_something_else(best, c)] if best.single else []
    return max(alike, key=lambda c: c.evidence, default=best)


def _says_something_else(best: _Candidate, other: _Candidate) -> bool:
    """Whether another explanation gives most flowers other partners."""
    mine, theirs = (_flower_pairs(c) for c in (best, other))
    return len(mine & theirs) < 0.5 * max(min(len(mine), len(theirs)), 1)


def _flower_pairs(candidate: _Candidate) -> set[tuple[int, int]]:
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


def _found(session: Constellation, alive: PlantMap, best: _Candidate) -> Found | None:
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
    pose = fit(pairs, scene.scale_range)
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
