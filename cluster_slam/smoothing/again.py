"""What is done again when flowers turn out to belong together otherwise than they were followed.

Clusters are known best at the end, when their motion is. Flowers that sway together and were followed one by one were
not found where they swayed, and those that were found looked like noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam.association.frames import Frames
from cluster_slam.config import SmoothConfig
from cluster_slam.graph.poses import PoseModel
from cluster_slam.graph.variance import VarianceFactors
from cluster_slam.records import BoolArray, IntArray
from cluster_slam.smoothing.rounds import drop_unsupported, followed, let_all_stand, solve
from cluster_slam.smoothing.world import World, for_solving, learn

_SAME = 0.1  # of a variance: sigmas to 5 %


def joined(before: IntArray, after: IntArray) -> BoolArray:
    """Which flowers (l,) are of clusters that were several before, whatever the clusters' numbers."""
    _, new = np.unique(np.stack([before, after]), axis=1)
    of_several: BoolArray = np.bincount(new)[after] > 1
    return of_several


def follow_joined(
    frames: Frames, model: PoseModel, world: World, cluster_before: IntArray, config: SmoothConfig
) -> World:
    """Follow those clusters again that were several before; what the others took stays theirs.

    What was found of a flower with mates that it has no more was found all the same: clusters that were parted stay.
    """
    again = joined(cluster_before, world.cluster)
    if not again.any():
        return world
    free = (world.landmark < 0) | again[world.landmark]
    number = np.where(again, np.cumsum(again) - 1, -1)
    alone = replace(
        world,
        landmark=np.where(world.landmark[free] < 0, -1, number[world.landmark[free]]),
        places=world.places[again],
        cluster=np.unique(world.cluster[again], return_inverse=True)[1],
    )
    found = followed(frames.only(free), model, alone, config)
    landmark = world.landmark.copy()
    landmark[free] = np.where(found < 0, -1, np.flatnonzero(again)[found])
    return replace(world, landmark=landmark)


def settle_again(
    stated: Frames, stated_poses: PoseModel, world: World, noise: VarianceFactors, config: SmoothConfig
) -> World:
    """Leave out what is no longer supported, and learn anew, from ``noise``, how large the errors are."""
    world = replace(drop_unsupported(stated, world, config), noise=noise)
    for _ in range(config.max_rounds):
        before = world.noise
        frames, model = for_solving(stated, stated_poses, world)
        world = learn(world, *solve(frames, model, world, config, 2))
        if same_noise(before, world.noise):
            break
    return let_all_stand(stated, world, config)


def same_noise(a: VarianceFactors, b: VarianceFactors) -> bool:
    """Whether two estimates of how large the errors are come to the same."""
    return bool(max(abs(np.log(b.flower / a.flower)), abs(np.log(b.pose / a.pose))) < _SAME)
