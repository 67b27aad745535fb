"""A bramble plant: canes, side branches, clusters of flowers along them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.errors import ConfigError
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from cluster_slam.simulate.config import SimulateConfig

_N_CANDIDATES = 12000  # places for clusters, of which some are taken
_CLOSE = 1.3  # neighbours stand within this many spacings
_STEM_POINTS = 24  # points a stem is drawn with


@dataclass(frozen=True, slots=True, eq=False)
class Plant:
    """The plant at rest in the world: row along x, z up, the arm on the side of negative y."""

    stems: Array  # (s, 24, 3) points along each cane and branch
    centroids: Array  # (c, 3) mean of each cluster's flowers
    attachments: Array  # (c, 3) where a cluster hangs on its stem
    tangents: Array  # (c, 3) direction of the stem there
    stem_ids: IntArray  # (c,) stem that carries the cluster
    flower_cluster: IntArray  # (f,) cluster of each flower
    flowers: Array  # (f, 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """Candidate places for clusters along the stems."""

    centroids: Array  # (m, 3)
    attachments: Array  # (m, 3)
    tangents: Array  # (m, 3)
    stem_ids: IntArray  # (m,)

    def take(self, index: IntArray) -> _Places:
        return _Places(self.centroids[index], self.attachments[index], self.tangents[index], self.stem_ids[index])


def grow_plant(config: SimulateConfig, *, rng: np.random.Generator) -> Plant:
    """Grow a plant as the configuration says; all lengths times ``config.scale``.

    Raises
    ------
    ConfigError
        The clusters or flowers do not fit at the spacing that is asked for.
    """
    counts = _flower_counts(config, rng)
    stems = _stems(config, rng)
    places = _candidates(stems, rng)
    places = places.take(_choose(places.centroids, len(counts), config, rng))
    flowers = _flowers(places.centroids, counts, config, rng)
    s = config.scale
    return Plant(
        stems=stems * s,
        centroids=places.centroids * s,
        attachments=places.attachments * s,
        tangents=places.tangents,
        stem_ids=places.stem_ids,
        flower_cluster=np.repeat(np.arange(len(counts)), counts),
        flowers=flowers * s,
    )


def _flower_counts(config: SimulateConfig, rng: np.random.Generator) -> IntArray:
    counts = config.flowers_min + rng.binomial(config.flowers_max - config.flowers_min, 0.4, config.n_clusters)
    n_loose = round(config.loose_share * counts.sum() / max(1.0 - config.loose_share, 0.05))
    return np.concatenate([counts, np.ones(n_loose, np.int64)])


def _stems(config: SimulateConfig, rng: np.random.Generator) -> Array:
    """Canes that rise from the row and arch over, and side branches that leave them."""
    n_canes = max(4, round(config.plant_width_m / 0.18))
    base = np.zeros((n_canes, 3))
    base[:, 0] = np.linspace(-0.45, 0.45, n_canes) * config.plant_width_m + rng.normal(0.0, 0.03, n_canes)
    base[:, 1] = 0.9 + rng.uniform(-0.1, 0.1, n_canes) * config.plant_depth_m
    tip = base + rng.uniform([-0.25, -0.5, 0.7], [0.25, 0.5, 1.0], (n_canes, 3)) * [
        1.0,
        config.plant_depth_m,
        config.plant_height_m,
    ]
    control = (base + tip) / 2
    control[:, 2] = tip[:, 2] * rng.uniform(0.9, 1.2, n_canes)
    canes = _bezier(base, control, tip)
    per_cane = 5
    at = rng.integers(_STEM_POINTS // 3, _STEM_POINTS, (n_canes, per_cane))
    start = np.take_along_axis(canes, at[..., None], axis=1).reshape(-1, 3)
    direction = rng.uniform([-1.0, -0.8, -0.2], [1.0, 0.5, 0.7], (n_canes * per_cane, 3))
    length = rng.uniform(0.1, 0.3, (n_canes * per_cane, 1)) * config.plant_height_m / 0.8
    end = start + length * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    middle = (start + end) / 2 + [0.0, 0.0, 0.04]
    return np.concatenate([canes, _bezier(start, middle, end)])


def _bezier(a: Array, b: Array, c: Array) -> Array:
    t = np.linspace(0.0, 1.0, _STEM_POINTS)[:, None]
    curve: Array = (1 - t) ** 2 * a[:, None] + 2 * t * (1 - t) * b[:, None] + t**2 * c[:, None]
    return curve


def _candidates(stems: Array, rng: np.random.Generator) -> _Places:
    """Places that hang 2 to 6 cm from a stem, above the lowest fifth of the plant, most of them towards the arm."""
    steps = np.diff(stems, axis=1)
    length = np.linalg.norm(steps, axis=2).sum(1)
    stem = rng.choice(len(stems), _N_CANDIDATES, p=length / length.sum())
    segment = rng.integers(0, _STEM_POINTS - 1, _N_CANDIDATES)
    tangent = steps[stem, segment]
    attachment = stems[stem, segment] + rng.random((_N_CANDIDATES, 1)) * tangent
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    out = rng.normal([0.0, -0.7, 0.2], 1.0, (_N_CANDIDATES, 3))
    out -= (out * tangent).sum(1, keepdims=True) * tangent
    out *= rng.uniform(0.02, 0.06, (_N_CANDIDATES, 1)) / np.linalg.norm(out, axis=1, keepdims=True)
    high = attachment[:, 2] > 0.2 * stems[..., 2].max()
    return _Places(attachment + out, attachment, tangent, stem).take(np.flatnonzero(high))


def _choose(places: Array, n: int, config: SimulateConfig, rng: np.random.Generator) -> IntArray:
    """Take n places no two of which are nearer than the spacing, some of them close to another."""
    chosen = np.empty(n, np.int64)
    nearest = np.full(len(places), np.inf)
    for i in range(n):
        free = np.flatnonzero(nearest >= config.cluster_spacing_m)
        if not len(free):
            raise ConfigError(
                f"only {i} of {n} clusters fit at cluster_spacing_m = {config.cluster_spacing_m}: "
                f"take a wider plant (plant_width_m = {config.plant_width_m})"
            )
        close = free[nearest[free] < _CLOSE * config.cluster_spacing_m]
        is_close = rng.random() < config.neighbour_share and len(close) > 0
        chosen[i] = rng.choice(close if is_close else free)
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[i]], axis=1))
    return chosen


def _flowers(centroids: Array, counts: IntArray, config: SimulateConfig, rng: np.random.Generator) -> Array:
    """Flowers about each centroid, their mean exactly there, none nearer than the flower spacing to any other."""
    radii = rng.uniform(config.cluster_radius_min_m, config.cluster_radius_max_m, len(counts))
    solid = centroids[counts == 1]  # single flowers stand where they must; the others give way
    placed: list[Array] = []
    for centroid, count, radius in zip(centroids, counts, radii, strict=True):
        if count == 1:
            placed.append(centroid[None])
            continue
        near = solid[np.linalg.norm(solid - centroid, axis=1) < 0.2]
        flowers = centroid + _offsets(near - centroid, int(count), float(radius), config.flower_spacing_m, rng)
        placed.append(flowers)
        solid = np.concatenate([solid, flowers])
    return np.concatenate(placed)


def _offsets(others: Array, count: int, radius: float, spacing: float, rng: np.random.Generator) -> Array:
    """Offsets (count, 3) with mean zero, the farthest at the radius, apart from each other and from others (k, 3)."""
    for _ in range(500):
        draws = rng.normal(size=(8 * count, 3))
        draws *= radius * np.cbrt(rng.random((8 * count, 1))) / np.linalg.norm(draws, axis=1, keepdims=True)
        kept = _apart(draws, count, spacing)
        offsets = kept - kept.mean(0)
        growth = radius / max(np.linalg.norm(offsets, axis=1).max(), 1e-9)
        if len(kept) < count or growth < 1.0:
            continue
        grown: Array = growth * offsets
        if (np.linalg.norm(grown[:, None] - others, axis=2) >= spacing).all():
            return grown
    raise ConfigError(f"{count} flowers do not fit within {radius:.3f} m at flower_spacing_m = {spacing}")


def _apart(points: Array, count: int, spacing: float) -> Array:
    """The first points, at most count, that keep the spacing from those before them."""
    kept = points[:1]
    for point in points[1:]:
        if len(kept) < count and np.linalg.norm(kept - point, axis=1).min() >= spacing:
            kept = np.concatenate([kept, point[None]])
    return kept
