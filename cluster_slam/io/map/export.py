"""A map as plain tables and a graph, and predictions as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.errors import OutputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.folder import check_writable, recover, write_folder
from cluster_slam.io.map.ledger import events, state_of
from cluster_slam.io.map.store import MapStore
from cluster_slam.records import PlantMap

FILES = frozenset({"clusters.csv", "flowers.csv", "sessions.csv", "events.csv", "map.g2o"})
COV = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
STATE = ("presence", "last_looked_at", "last_seen", "state")
_UPPER = np.triu_indices(3)


def export_map(store: MapStore, out: Path) -> None:
    """Write clusters, flowers, sessions and events as CSV, and the map as a g2o graph.

    Raises
    ------
    OutputError
        ``out`` holds anything but an earlier export, or cannot be written.
    """
    check_writable(out)
    recover(out)
    foreign = sorted(e.name for e in out.iterdir() if e.name not in FILES) if out.exists() else []
    if foreign:
        raise OutputError(f"{out}: holds {foreign[0]}, expected a free name, an empty folder or an earlier export")
    plants = store.plants()
    write_folder(
        out,
        {
            "clusters.csv": _clusters(plants),
            "flowers.csv": _flowers(plants),
            "sessions.csv": _sessions(store),
            "events.csv": _events(store),
            "map.g2o": _graph(store, plants),
        },
    )


def cluster_position_covs(plant: PlantMap) -> Array:
    """Covariances (c, 3, 3) of the centroids: what the flowers share, and their own errors."""
    row, n = plant.flower_rows, len(plant.cluster_ids)
    alive = plant.flower_presence > 0.5
    total = np.zeros((n, 3, 3))
    np.add.at(total, row[alive], plant.flower_covs[alive])
    counts = np.maximum(np.bincount(row[alive], minlength=n), 1)
    covs: Array = plant.cluster_covs + total / (counts**2)[:, None, None]
    return covs


def _clusters(plants: Iterable[PlantMap]) -> str:
    header = ["map_id", "plant", "x", "y", "z", *COV, *STATE, "n_flowers", "inertia", "mean_distance"]
    rows = []
    for p in plants:
        covs = cluster_position_covs(p)[:, _UPPER[0], _UPPER[1]]
        for k, i in enumerate(p.cluster_ids.tolist()):
            looked, seen = p.cluster_last_looked_at[k], p.cluster_last_seen[k]
            state = _state(p.cluster_presence[k], looked, seen)
            rows.append(
                [i, p.name, *_point(p.clusters[k], covs[k]), *state, int(p.n_flowers[k]), *_short(p.descriptors[k])]
            )
    return table(header, rows)


def _flowers(plants: Iterable[PlantMap]) -> str:
    header = ["map_id", "plant", "x", "y", "z", *COV, *STATE, "cluster_map_id"]
    rows = []
    for p in plants:
        covs = p.flower_total_covs[:, _UPPER[0], _UPPER[1]]
        for k, i in enumerate(p.flower_ids.tolist()):
            state = _state(p.flower_presence[k], p.flower_last_looked_at[k], p.flower_last_seen[k])
            rows.append([i, p.name, *_point(p.flowers[k], covs[k]), *state, int(p.flower_cluster_ids[k])])
    return table(header, rows)


def _state(presence: float, looked: float, seen: float) -> list[str]:
    return [f"{presence:.6f}", _stamp(looked), _stamp(seen), state_of(float(presence))]


def _stamp(time: float) -> str:
    return "" if np.isnan(time) else f"{time:.6f}"


def _point(position: Array, cov: Array) -> list[str]:
    return [*(f"{x:.9f}" for x in position.tolist()), *_short(cov)]


def _short(values: Array) -> list[str]:
    return [f"{x:.9g}" for x in values.tolist()]


def _sessions(store: MapStore) -> str:
    header = ["id", "plant", "start", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "end", "scale", "kind", "probability"]
    rows = [
        [
            *(s.session, s.plant, _stamp(s.start)),
            *(f"{x:.12g}" for x in tum_from_pose(s.T_map_world).tolist()),
            *(_stamp(s.end), f"{s.scale:.9g}", s.kind, f"{s.probability:.6f}"),
        ]
        for s in store.sessions()
    ]
    return table(header, rows)


def _events(store: MapStore) -> str:
    return table(
        ["map_id", "kind", "time", "note"], [[e.cluster, e.kind, _stamp(e.time), e.note] for e in events(store)]
    )


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A CSV table as text."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return out.getvalue()


def _graph(store: MapStore, plants: Iterable[PlantMap]) -> str:
    """Sessions as poses T_map_world and clusters as points, tied by what each session saw of them."""
    lines = []
    sessions = store.sessions()
    n = len(sessions)
    for k, s in enumerate(sessions):
        lines.append(f"VERTEX_SE3:QUAT {k} " + " ".join(f"{x:.12g}" for x in tum_from_pose(s.T_map_world).tolist()))
    for p in plants:
        for i, place in zip(p.cluster_ids.tolist(), p.clusters.tolist(), strict=True):
            lines.append(f"VERTEX_TRACKXYZ {n + i} " + " ".join(f"{x:.9f}" for x in place))
    lines.append("PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1")
    for k, s in enumerate(sessions):
        R, t = s.T_map_world[:3, :3], s.T_map_world[:3, 3]
        seen = store.read(
            "SELECT cluster_id, x, y, z FROM observations WHERE session_id = ? AND x IS NOT NULL", (s.id,)
        )
        for cluster, *place in seen:
            local = R.T @ (np.array(place) - t)
            point = " ".join(f"{x:.9f}" for x in local.tolist())
            lines.append(f"EDGE_SE3_TRACKXYZ {k} {n + cluster} 0 {point} 1e6 0 0 1e6 0 1e6")
    return "\n".join([*lines, ""])


def predictions(plants: Iterable[PlantMap], covs: Iterable[Array]) -> str:
    """A table of where each cluster will be, with the covariances (c, 3, 3) of each plant."""
    header = ["map_id", "plant", "x", "y", "z", *COV, "presence"]
    rows = []
    for p, cov in zip(plants, covs, strict=True):
        upper = cov[:, _UPPER[0], _UPPER[1]]
        for k, i in enumerate(p.cluster_ids.tolist()):
            rows.append([i, p.name, *_point(p.clusters[k], upper[k]), f"{p.cluster_presence[k]:.6f}"])
    return table(header, rows)
