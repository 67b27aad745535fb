"""Seasons at the level of rest positions, through the public library call, and their score."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.geometry import inverse, se3_log, transform
from cluster_slam.io.map import create_map
from cluster_slam.io.map.check import problems
from cluster_slam.io.map.incoming import Incoming
from cluster_slam.io.map.store import MapStore
from cluster_slam.pipeline.remember import add
from cluster_slam.records import IntArray
from cluster_slam.remember.predict import predict_plant
from cluster_slam.remember.score import Confusion, confusion
from cluster_slam.simulate.season import Rest, SeasonConfig, SeasonPlant


@dataclass(slots=True)
class Season:
    """What came of a season: pooled over all sessions but the first."""

    clusters: Confusion = field(default_factory=Confusion)
    flowers: Confusion = field(default_factory=Confusion)
    nees: list[float] = field(default_factory=list)  # of T_map_world, 6 degrees of freedom
    prediction_nees: list[float] = field(default_factory=list)  # of clusters, 3 degrees of freedom
    unvisited_presence: list[float] = field(default_factory=list)
    reliability: list[tuple[float, bool]] = field(default_factory=list)  # probability of a match, and is it right
    n_refused: int = 0
    problems: list[str] = field(default_factory=list)  # of the map at the end


def identities(store: MapStore, table: str, what: str, session: int) -> IntArray:
    """``local_id, map_id, is_new`` of a session (n, 3), by local id; the probability in millionths as a fourth."""
    rows = store.read(
        f"SELECT local_id, {what}_id, is_new, CAST(1e6 * probability AS INTEGER) FROM {table} "
        "WHERE session_id = ? AND local_id IS NOT NULL ORDER BY local_id",
        (session,),
    )
    return np.array(rows, dtype=np.int64)


def all_missed(true_ids: IntArray, known: dict[int, int]) -> Confusion:
    """A session that was refused: all that the map had is missed."""
    there = np.isin(true_ids[true_ids >= 0], list(known.values()))
    return Confusion(missed=int(there.sum()), new=int((~there).sum()))


def run_season(folder: Path, config: SeasonConfig, options: MapConfig, *, seed: int) -> Season:
    """All days of a season into one map."""
    plant, out = SeasonPlant(config, seed=seed), Season()
    known: tuple[dict[int, int], dict[int, int]] = {}, {}
    first: Rest | None = None
    with create_map(folder / f"{seed}.map") as store:
        for day in config.day_list:
            plant.grow_to(day)
            rest = plant.rest()
            predicted = None if first is None else predict_plant(store.plants()[0], rest.constellation.start, options)
            added = add(store, Incoming(rest.constellation, "result", str(day)), config=options)
            if added.session is None:
                out.n_refused += 1
                out.clusters += all_missed(rest.true_clusters, known[0])
                out.flowers += all_missed(rest.true_flowers, known[1])
                continue
            clusters = identities(store, "observations", "cluster", added.session.id)
            flowers = identities(store, "flower_observations", "flower", added.session.id)
            if predicted is not None and first is not None:
                moved, covs = predicted
                centres = transform(added.session.T_map_world, rest.constellation.clusters)
                for local, name, is_new, _ in clusters.tolist():
                    if not is_new and known[0].get(name) == rest.true_clusters[local]:
                        row = int(np.searchsorted(moved.cluster_ids, name))
                        error = centres[local] - moved.clusters[row]
                        out.prediction_nees.append(float(error @ np.linalg.solve(covs[row], error)))
                for local, name, is_new, millionths in flowers.tolist():
                    if not is_new:
                        is_right = known[1].get(name) == rest.true_flowers[local]
                        out.reliability.append((millionths / 1e6, is_right))
                truth = inverse(first.T_map_world) @ rest.T_map_world
                error = se3_log(inverse(truth) @ added.session.T_map_world)
                out.nees.append(float(error @ np.linalg.solve(added.session.cov, error)))
                names = store.plants()[0]
                unseen = ~np.isin(names.cluster_ids, clusters[:, 1])
                out.unvisited_presence += names.cluster_presence[unseen].tolist()
            scores = (
                confusion(rest.true_clusters, clusters[:, 1], clusters[:, 2], known[0]),
                confusion(rest.true_flowers, flowers[:, 1], flowers[:, 2], known[1]),
            )
            if first is not None:
                out.clusters, out.flowers = out.clusters + scores[0], out.flowers + scores[1]
            first = first or rest
        out.problems += problems(store)
    return out
