"""Times of the map: adding sessions of 20 and of 500 clusters, and the size of the file. CPU seconds.

Run: python benchmarks/bench_map.py
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np

from cluster_slam.geometry import se3_exp, transform
from cluster_slam.io.map import create_map
from cluster_slam.io.map.incoming import Incoming
from cluster_slam.pipeline.remember import add
from cluster_slam.records import Constellation

DAY_S = 86400.0


def row_of(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Flowers and their clusters of a row of n clusters, 8 a metre."""
    centres = rng.uniform([0.0, 0.0, 0.0], [n / 16, 0.4, 1.2], (n, 3))
    cluster = np.repeat(np.arange(n), rng.integers(3, 7, n))
    return centres[cluster] + rng.normal(0.0, 0.02, (len(cluster), 3)), cluster


def session_of(points: np.ndarray, cluster: np.ndarray, name: str, day: float) -> Incoming:
    n, f = int(cluster.max()) + 1, len(points)
    covs = np.tile(1e-6 * np.eye(3), (f, 1, 1))
    none = np.zeros((n, 2)), np.zeros((n, 2, 2))
    start = 1.7e9 + day * DAY_S
    found = Constellation(name, start, start + 30, np.arange(f), cluster, points, covs, np.arange(n), *none)
    return Incoming(found, "result", name)


def timed(n_plants: int, n_clusters: int) -> None:
    rng = np.random.default_rng(0)
    path = Path(tempfile.mkdtemp()) / "bench.map"
    with create_map(path) as store:
        for k in range(n_plants):
            points, cluster = row_of(n_clusters, rng)
            add(store, session_of(points, cluster, f"first {k}", 0.0), plant=f"row {k}")
        drift = rng.normal(0.0, 0.003 / np.sqrt(3), (n_clusters, 3))[cluster]
        moved = transform(se3_exp(rng.normal(0.0, 0.3, 6)), points + drift + rng.normal(0.0, 0.0006, points.shape))
        incoming = session_of(moved, cluster, "second", 1.0)
        begin = process_time()
        added = add(store, incoming, plant=f"row {n_plants - 1}")
        named = process_time() - begin
        again = replace(incoming, constellation=replace(incoming.constellation, session="third"))
        begin = process_time()
        add(store, again)
        unnamed = process_time() - begin
    size = path.stat().st_size / 1e6
    total = n_plants * n_clusters
    print(
        f"{n_clusters} clusters into {total}: {named:.2f} s named, {unnamed:.2f} s unnamed, "
        f"{added.n_known} known again; {1000 * size / total:.2f} MB a 1,000 clusters"
    )


if __name__ == "__main__":
    timed(50, 20)
    timed(100, 500)
