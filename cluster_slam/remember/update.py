"""What a session changes in a plant: drift and growth learned, flowers moved, new ones, and who may be gone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.growth import at
from cluster_slam.constellation.identify import Identities
from cluster_slam.records import BoolArray, Constellation, IntArray, PlantMap
from cluster_slam.remember.follow import Follower
from cluster_slam.remember.tables import Aligned, summarised, with_new


@dataclass(frozen=True, slots=True, eq=False)
class Updated:
    """A plant after a session, and what the session's clusters and flowers are called in it."""

    plant: PlantMap
    cluster_map_ids: IntArray  # (c,) of the session's clusters
    flower_map_ids: IntArray  # (f,)
    missed: IntArray  # cluster ids that were looked at and not seen


def update(
    plant: PlantMap,
    session: Constellation,
    where: Aligned,
    who: Identities,
    looked: BoolArray,
    config: MapConfig,
    next_cluster: int,
    next_flower: int,
) -> Updated:
    """The plant after a session.

    Parameters
    ----------
    plant
        As the map holds it, not moved.
    who
        Rows of ``plant`` for the session's clusters and flowers.
    looked
        (g,) which of the plant's flowers the session looked at.
    next_cluster, next_flower
        The first free ids.
    """
    now = session.end if np.isnan(session.start) else session.start
    moved = at(plant, now, config.growth)
    kept = Follower(plant, moved, where, who, config, now)
    kept.follow_clusters()
    kept.look(looked)
    kept.learn_growth()
    after = replace(kept.result(), drift_rate=kept.learn_drift(), walk_rate=kept.walk_rate)
    grown, cluster_ids, flower_ids = with_new(after, session, where, who, config.growth, now, next_cluster, next_flower)
    missed = plant.cluster_ids[kept.missed]
    return Updated(summarised(grown), cluster_ids, flower_ids, missed)
