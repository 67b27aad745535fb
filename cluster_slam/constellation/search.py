"""Candidates: poses of a session on a plant, guessed from nothing, refined, and what each explains."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.config import GrowthConfig, MatchConfig
from cluster_slam.constellation.evidence import evidence_of
from cluster_slam.constellation.explain import Explained, Scene, explain, n_flowers, refine
from cluster_slam.constellation.growth import DAY_S
from cluster_slam.constellation.plane import Space, spaces
from cluster_slam.constellation.poses import Places, best_distinct, guess_poses, quick_scores
from cluster_slam.constellation.similarity import concatenate
from cluster_slam.constellation.units import Units, background_of, plant_units, session_units
from cluster_slam.records import Constellation, PlantMap

SINGLES_UP_TO = 80  # flowers on each side that are also matched one by one
N_REFINED = 6
N_TOGETHER = 3  # poses of single flowers that are looked at with clusters as units, too
GLANCE_SEEDS, GLANCE_POSES = 10, 300  # of a glance
LOOKS = 4000  # clusters that are looked at closely, over all poses: large plants need fewer poses to tell
REPEATED_SHARE = 0.7  # of the centres: a second pose that puts so many on others means a repeated structure


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    space: Space
    scene: Scene
    found: Explained
    evidence: float
    single: bool


def candidates_of(
    session: Constellation, alive: PlantMap, config: MatchConfig, growth: GrowthConfig, *, similarity: bool
) -> tuple[list[Candidate], bool]:
    """The best explanations of all kinds, and whether the layout of the clusters fits in several ways."""
    candidates: list[Candidate] = []
    repeated = False
    for space, single in _ways(session, alive):
        scene = _scene(session, alive, space, config, growth, single=single, similarity=similarity)
        if scene is None:
            continue
        explained, again = _search(scene)
        repeated |= again
        candidates += [Candidate(space, scene, e, evidence_of(scene, e, single=single), single) for e in explained]
        by_clusters = _scene(session, alive, space, config, growth, single=False, similarity=similarity)
        if single and space.d == 3 and by_clusters is not None:  # in a plane two clusters were enough before
            candidates += _together(space, by_clusters, explained)
    return candidates, repeated


def glance(session: Constellation, plant: PlantMap, config: MatchConfig, *, similarity: bool = False) -> float:
    """How well the centres alone agree under a few guessed poses: a score to rank many plants by, quickly."""
    alive = still_there(plant)
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


def still_there(plant: PlantMap) -> PlantMap:
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


def _together(space: Space, by_clusters: Scene, explained: list[Explained]) -> list[Candidate]:
    """The likeliest poses of flowers one by one, with clusters as units: few in common place flowers, not centroids."""
    poses = [e.pose for e in explained[:N_TOGETHER] if n_flowers(e) >= 3]
    found = [refine(by_clusters, e) for e in explain(by_clusters, concatenate(poses))] if poses else []
    return [Candidate(space, by_clusters, e, evidence_of(by_clusters, e, single=False), False) for e in found]
