"""All living clusters at one instant, as an update says them."""

from __future__ import annotations

import numpy as np

from cluster_slam.online.records import Tracks
from cluster_slam.online.world import World
from cluster_slam.records import IntArray


def tracks_of(world: World, stamp: float, flower_ids: IntArray | None) -> Tracks:
    """Clusters as they are at ``stamp``: seen ones as measured, others as predicted; ``flower_ids`` are those seen."""
    n = len(world.clusters)
    positions, velocities, covs = world.anchors(), np.zeros((n, 3)), world.covs_at_rest(stamp)
    for j, k in enumerate(world.clusters):
        if k.is_moving:
            positions[j], velocities[j], covs[j] = k.now(stamp)
        elif k.trembling is not None and stamp <= k.last:
            d, P = k.trembling
            positions[j] += d
            covs[j, :3, :3] = P + k.anchor_cov
    seen = np.isin(world.flowers.ids, np.zeros(0) if flower_ids is None else flower_ids)
    return Tracks(
        ids=world.names(),
        positions=positions,
        velocities=velocities,
        covs=covs,
        scales=np.array([k.scale for k in world.clusters]),
        states=tuple(k.state for k in world.clusters),
        motions=tuple(k.kind.value for k in world.clusters),
        reasons=tuple(k.why for k in world.clusters),
        n_flowers=np.bincount(world.flowers.slot, minlength=n),
        seen=np.bincount(world.flowers.slot[seen], minlength=n),
    )
