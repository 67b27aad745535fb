"""How sure a session's place in its plant's frame is: what all clusters drift in common cannot be told from the base.

Each session is aligned with where the clusters are expected. What they drifted in common since the plant's first
session, three shifts and three turns, goes into that expectation unseen, velocities too, and so it goes on: the error
of the first alignment returns in each later one, larger by as much as drift has grown since. That the flowers of a
cluster do not turn in it with the base helps against it in the first alignment only; after that the layout of all
clusters, whose velocities are known, decides where the base stands. It is the mean over all of the plant's clusters
that matters, of which a session may have seen a part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_slam.constellation.fit import Pairs, pose_covariance
from cluster_slam.constellation.growth import drifted
from cluster_slam.geometry import Array
from cluster_slam.io.map.store import StoredSession
from cluster_slam.records import PlantMap


def frame_covariance(
    pairs: Pairs,
    scale: float,
    plant: PlantMap,
    sessions: Sequence[StoredSession],
    now: float,
    memory_days: float,
    *,
    drift_factor: float = 1.0,
    with_scale: bool,
) -> Array:
    """Covariance (6, 6) of T_map_world, of the tangent on the right, to the frame of the plant's first session.

    Parameters
    ----------
    pairs
        Matched flowers, ``a`` and ``b`` where the session has them in its own world.
    sessions
        The plant's, in the order in which they came; the first made its frame.
    now
        s, of the session that was aligned.
    drift_factor
        Variance of the drift over what was expected, as this session has it: while nothing else has been learned of it.
    """
    begin = sessions[0].start
    since = drifted(plant, now - begin, memory_days)
    first_gap = since if len(sessions) < 2 else drifted(plant, sessions[1].start - begin, memory_days)
    since *= drift_factor if len(sessions) < 2 else 1.0
    grown = max(since / first_gap, 1.0) if first_gap > 0.0 else 1.0
    common = since * min(pairs.n_units / max(int((plant.cluster_presence > 0.5).sum()), 1), 1.0)
    pairs = replace(pairs, var_offset=np.maximum(pairs.var_offset, common), variance=pairs.variance * grown)
    return pose_covariance(pairs, scale, with_scale=with_scale)
