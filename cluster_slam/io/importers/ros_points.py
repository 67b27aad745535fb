"""Flowers as a ``PointCloud2`` in the camera's frame: x, y, z, and where there are such fields score and covariance."""

from __future__ import annotations

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.importers.recording import FlowerRows, joined
from cluster_slam.io.importers.ros_bag import Bag, seconds
from cluster_slam.io.importers.session_files import COV_NAMES

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def flower_rows(bag: Bag, topic: str) -> FlowerRows:
    """All points of a topic.

    Raises
    ------
    InputError
        No fields x, y, z.
    """
    stamps, points, scores, covs = [], [], [], []
    has_cov = True
    for _, _, message in bag.messages([topic]):
        order = ">" if message.is_bigendian else "<"
        fields = {f.name: (order + _KINDS[f.datatype], f.offset) for f in message.fields if f.datatype in _KINDS}
        missing = [name for name in "xyz" if name not in fields]
        if missing:
            raise InputError(f"{bag.path}: {topic}: no field {missing[0]!r}, expected x, y, z")
        kind = np.dtype(
            {
                "names": list(fields),
                "formats": [f for f, _ in fields.values()],
                "offsets": [o for _, o in fields.values()],
                "itemsize": message.point_step,
            }
        )
        cloud = np.frombuffer(bytes(message.data), kind, int(message.width) * int(message.height))
        columns: dict[str, Array] = {name: cloud[name].astype(float) for name in fields}
        finite = np.isfinite(np.stack([columns[name] for name in "xyz"], axis=1)).all(axis=1)
        stamps.append(np.full(int(finite.sum()), seconds(message.header.stamp)))
        points.append(np.stack([columns[name] for name in "xyz"], axis=1)[finite])
        scores.append(columns.get("score", np.full(len(cloud), np.nan))[finite])
        has_cov = has_cov and all(name in columns for name in COV_NAMES)
        if has_cov:
            covs.append(np.stack([columns[name] for name in COV_NAMES], axis=1)[finite])
    upper = joined(covs, 6) if has_cov else None
    full = None if upper is None else upper[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    all_stamps = np.concatenate(stamps) if stamps else np.zeros(0)
    return FlowerRows(all_stamps, joined(points, 3), full, np.concatenate(scores) if scores else None)
