"""A season of one plant: it drifts and grows, flowers open and drop, and each session's base stands elsewhere.

Two levels: ``rest`` gives what a perfect smoothing would put into a map, perturbed, in a millisecond; ``record`` a raw
session, to be smoothed like any other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from cluster_slam.errors import ConfigError
from cluster_slam.geometry import Array, inverse, so3_exp, transform
from cluster_slam.io.session_writer import check_session_output, write_session
from cluster_slam.records import CLUTTER, Constellation, IntArray, Truth
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.plant import Plant, grow_plant
from cluster_slam.simulate.session import Simulated, simulate_session

DAY_S = 86400.0
START_S = 1_777_888_800.0  # 2026-05-04 10:00 UTC


@dataclass(frozen=True, slots=True)
class SeasonConfig:
    """How a plant changes, and how its sessions see it. The defaults are the preset ``season``."""

    days: str = "0 1 3 7 14"  # on which there is a session
    drift_m_per_day: float = 0.003  # RMS norm of a cluster's drift, each in a direction of its own
    common_drift_m_per_day: float = 0.0  # upwards, of all clusters
    walk_m_per_sqrt_day: float = 0.0  # random walk of a cluster, one sigma an axis
    size_per_day: float = 0.01  # growth of all lengths within a cluster
    lost_per_day: float = 0.02  # share of the flowers
    new_per_day: float = 0.03  # share of the flowers
    base_shift_m: float = 0.5  # of the base between sessions
    base_tilt_rad: float = 0.07  # one sigma, about a level axis
    base_yaw_rad: float = 3.14159  # uniform within plus and minus
    visited_share: float = (
        1.0  # of the clusters: others each day at the level ``rest``, one side of a cut when recorded
    )
    unseen_share: float = 0.0  # of the flowers, anew in each session
    ghosts: int = 0  # false flowers that a session cannot tell from true ones
    rest_sigma_m: float = 0.0006  # of a flower at rest after smoothing, at the level ``rest``
    session: SimulateConfig = field(default_factory=SimulateConfig)

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if isinstance(value, float | int) and not 0 <= value < np.inf:
                raise ConfigError(f"{name} must be a number from 0, not {value}")
        if not 0 < self.visited_share <= 1 or self.unseen_share >= 1:
            raise ConfigError("visited_share must lie within 0 and 1, and unseen_share below 1")

    @property
    def day_list(self) -> list[float]:
        """The days as numbers, increasing.

        Raises
        ------
        ConfigError
            They are not numbers that increase from 0.
        """
        try:
            days = [float(word) for word in self.days.replace(",", " ").split()]
        except ValueError:
            days = []
        if not days or days[0] < 0 or any(b < a for a, b in pairwise(days)):
            raise ConfigError(f"days is {self.days!r}, expected numbers that increase, as '0 1 3 7 14'")
        return days


SEASON = SeasonConfig()
HARD_SEASON = replace(SEASON, visited_share=0.6, unseen_share=0.2, ghosts=3)
SEASONS = {"season": SEASON, "season-hard": HARD_SEASON}


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """A session as a perfect smoothing would leave it, and what is true about it."""

    constellation: Constellation
    true_clusters: IntArray  # (c,) of the constellation's clusters
    true_flowers: IntArray  # (f,) CLUTTER: a ghost
    T_map_world: Array  # (4, 4)


class SeasonPlant:
    """A plant that changes from day to day. True ids are the same on all days."""

    def __init__(self, config: SeasonConfig, *, seed: int) -> None:
        self.config = config
        self.seed = seed
        self.rng = np.random.default_rng([seed, *b"season"])
        self.start = grow_plant(config.session, rng=np.random.default_rng([seed, *b"plant"]))
        n = len(self.start.centroids)
        self.centroids = self.start.centroids.copy()
        self.cluster = self.start.flower_cluster.copy()
        self.offsets = self.start.flowers - self.centroids[self.cluster]
        self.ids = np.arange(len(self.cluster))
        self.day = config.day_list[0]
        self.velocities = self.rng.normal(size=(n, 3)) * config.drift_m_per_day / np.sqrt(3.0)
        self.velocities[:, 2] += config.common_drift_m_per_day

    @property
    def flowers(self) -> Array:
        """Where the flowers are today (f, 3), in the frame of the season."""
        return self.centroids[self.cluster] + self.offsets

    def grow_to(self, day: float) -> None:
        """Let days pass: drift, growth, flowers lost and new."""
        config, rng, days = self.config, self.rng, day - self.day
        walk = config.walk_m_per_sqrt_day * np.sqrt(days)
        self.centroids = self.centroids + days * self.velocities + walk * rng.normal(size=self.centroids.shape)
        self.offsets = self.offsets * (1.0 + config.size_per_day * days)
        keep = rng.random(len(self.ids)) < (1.0 - config.lost_per_day) ** days
        self._open(rng.poisson(config.new_per_day * days * np.ones(len(self.ids))))
        keep = np.concatenate([keep, np.ones(len(self.ids) - len(keep), dtype=bool)])
        self.ids, self.cluster, self.offsets = self.ids[keep], self.cluster[keep], self.offsets[keep]
        self.day = day

    def _open(self, counts: IntArray) -> None:
        """New flowers near those that are there, about where their clusters are."""
        beside = np.repeat(np.arange(len(counts)), counts)
        size = np.maximum(np.linalg.norm(self.offsets[beside], axis=1, keepdims=True), 0.015)
        new = self.rng.normal(size=(len(beside), 3)) * size / np.sqrt(3.0)
        first = int(self.ids.max(initial=-1)) + 1
        first = max(first, getattr(self, "_next", first))
        self.ids = np.concatenate([self.ids, first + np.arange(len(beside))])
        self._next = first + len(beside)
        self.cluster = np.concatenate([self.cluster, self.cluster[beside]])
        self.offsets = np.concatenate([self.offsets, new])

    def visited(self, *, cut: bool) -> IntArray:
        """Clusters that a session of today visits: any; with a cut, all on the first day, then one side of it."""
        n = len(self.centroids)
        if cut and self.day == self.config.day_list[0]:
            return np.arange(n)
        side = self.rng.choice([-1.0, 1.0]) * self.centroids[:, 0] if cut else self.rng.random(n)
        return np.sort(np.argsort(side)[: max(3, round(self.config.visited_share * n))])

    def seen(self, visited: IntArray) -> tuple[Array, IntArray, IntArray]:
        """Flowers (f, 3), ids and clusters (f,) that today's session can see, ghosts among them."""
        rng, config = self.rng, self.config
        keep = (rng.random(len(self.ids)) >= config.unseen_share) & np.isin(self.cluster, visited)
        beside = rng.choice(visited, config.ghosts)
        false = self.centroids[beside] + rng.normal(0.0, 0.03, (config.ghosts, 3))
        return (
            np.concatenate([self.flowers[keep], false]),
            np.concatenate([self.ids[keep], np.full(config.ghosts, CLUTTER)]),
            np.concatenate([self.cluster[keep], beside]),
        )

    def base(self) -> Array:
        """T_map_world (4, 4) of a base that stands somewhere else."""
        rng, config = self.rng, self.config
        tilt = rng.normal(size=3) * config.base_tilt_rad * [1.0, 1.0, 0.0]
        yaw = np.array([0.0, 0.0, rng.uniform(-1.0, 1.0) * config.base_yaw_rad])
        T = np.eye(4)
        T[:3, :3] = so3_exp(tilt) @ so3_exp(yaw)
        T[:3, 3] = rng.normal(size=3) * config.base_shift_m / np.sqrt(3.0)
        return T

    def rest(self) -> Rest:
        """Today's session as a perfect smoothing would leave it."""
        rng, config = self.rng, self.config
        points, ids, cluster = self.seen(self.visited(cut=False))
        T = self.base()
        world = transform(inverse(T), points) + rng.normal(0.0, config.rest_sigma_m, points.shape)
        names, row = np.unique(cluster, return_inverse=True)
        order, shuffled = rng.permutation(len(ids)), rng.permutation(len(names))
        true_clusters = np.empty(len(names), dtype=np.int64)
        true_clusters[shuffled] = names
        n = len(names)
        covs = np.tile(max(config.rest_sigma_m, 1e-5) ** 2 * np.eye(3), (len(ids), 1, 1))
        start = START_S + self.day * DAY_S
        constellation = Constellation(
            session=f"simulated-{self.seed}-day-{self.day:g}",
            start=start,
            end=start + config.session.duration_s,
            flower_ids=np.arange(len(ids)),
            flower_cluster_ids=shuffled[row[order]],
            flowers=world[order],
            flower_covs=covs,
            cluster_ids=np.arange(n),
            descriptors=np.zeros((n, 2)),
            descriptor_covs=np.zeros((n, 2, 2)),
        )
        return Rest(constellation, true_clusters, ids[order], T)

    def record(self) -> tuple[Simulated, Truth]:
        """Today's raw session, and what is true about it with the season's ids."""
        visited = self.visited(cut=True)
        points, ids, cluster = self.seen(visited)
        names, row = np.unique(cluster, return_inverse=True)
        plant = _today(self.start, points, names, row)
        part = None if self.config.visited_share >= 1 else plant
        made = simulate_session(
            self.config.session, seed=self.seed * 1000 + round(10 * self.day), plant=plant, visited=part
        )
        T = self.base()
        T_world_map = inverse(T)
        session = replace(
            made.session,
            id=f"simulated-{self.seed}-day-{self.day:g}",
            plant=f"simulated-{self.seed}",
            stamps=np.round(made.session.stamps + self.day * DAY_S, 6),
            poses=T_world_map @ made.session.poses,
        )
        flower = made.truth.flower_ids
        seen = np.array([], dtype=np.int64) if flower is None else flower
        known = np.where(seen >= 0, ids[np.maximum(seen, 0)], CLUTTER)
        real = ids >= 0
        truth = Truth(
            T_world_camera=None if made.truth.T_world_camera is None else T_world_map @ made.truth.T_world_camera,
            flower_ids=known,
            cluster_ids=np.where(known >= 0, cluster[np.maximum(seen, 0)], CLUTTER),
            rest_flower_ids=ids[real],
            rest_cluster_ids=cluster[real],
            rest_positions=transform(T_world_map, points[real]),
            T_map_world=T,
            T_flange_camera=made.truth.T_flange_camera,
        )
        return replace(made, session=session, truth=truth), truth


def _today(start: Plant, flowers: Array, names: IntArray, row: IntArray) -> Plant:
    """A plant of the flowers that are seen today; clusters keep the stem that carries them."""
    counts = np.bincount(row, minlength=len(names))
    centroids = np.stack([np.bincount(row, x, len(names)) for x in flowers.T], axis=1) / counts[:, None]
    moved = centroids - start.centroids[names]
    return Plant(
        stems=start.stems,
        centroids=centroids,
        attachments=start.attachments[names] + moved,
        tangents=start.tangents[names],
        stem_ids=start.stem_ids[names],
        flower_cluster=row.astype(np.int64),
        flowers=flowers,
    )


def simulate_season(config: SeasonConfig, out: Path, *, seed: int) -> list[Path]:
    """Write one session a day into ``out/day-00``, ``out/day-01``, ... each whole or not at all.

    Raises
    ------
    ConfigError
        The plant does not fit its own spacings.
    OutputError
        A folder there holds something that is no earlier session, or cannot be written.
    """
    days = config.day_list
    folders = [out / f"day-{day:04.1f}".replace(".0", "") for day in days]
    for folder in folders:
        check_session_output(folder)
    plant = SeasonPlant(config, seed=seed)
    for day, folder in zip(days, folders, strict=True):
        plant.grow_to(day)
        made, truth = plant.record()
        write_session(folder, made.session, truth, camera=made.camera)
    return folders
