"""The plant as it is rendered: stems, foliage, flowers on their stalks, what is behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.leaves import Leaves
from cluster_slam.simulate.plant import Plant
from cluster_slam.simulate.render.facets import Builder, Facets, Texture
from cluster_slam.simulate.render.flowers import add_distractor, add_flower
from cluster_slam.simulate.render.shapes import SQUARE, half_leaf

_TO_ARM = np.array([0.0, -1.0, 0.35])
_TILES = 10  # of the backdrop, along each side
_CORRIDOR = 0.7  # a leaf in front of a flower is this far beside it for each metre it is nearer to the arm


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All that is seen, and by which light."""

    facets: Facets
    centroids: Array  # (c, 3) about which clusters turn
    sun: Array  # (3,) unit vector towards it
    sun_colour: Array  # (3,) blue, green, red
    sky_colour: Array  # (3,)


def build_scene(config: SimulateConfig, plant: Plant, leaves: Leaves, *, rng: np.random.Generator) -> Scene:
    """Dress a plant: every choice of looks is drawn here, once."""
    out = Builder()
    stem_rng, leaf_rng, flower_rng, other_rng, light_rng = rng.spawn(5)
    _backdrop(out, config, plant, other_rng)
    _behind(out, config, plant, other_rng)
    _stems(out, config, plant, stem_rng)
    _foliage(out, config, plant, leaf_rng)
    _front_leaves(out, plant, leaves, leaf_rng)
    _flowers(out, config, plant, flower_rng)
    _distractors(out, config, plant, other_rng)
    sun = np.array([light_rng.uniform(-0.7, 0.7), light_rng.uniform(-0.9, -0.2), light_rng.uniform(0.5, 1.0)])
    warm = light_rng.uniform(0.85, 1.0)
    look = config.look
    return Scene(
        out.build(),
        plant.centroids,
        sun / np.linalg.norm(sun),
        look.sun * np.array([warm * 0.92, 0.97, 1.0]),
        look.sky * np.array([1.1, 1.0, 0.92]),
    )


def _green(rng: np.random.Generator) -> Array:
    """A leaf's colour: from young yellow-green to old blue-green."""
    young, old = np.array([0.05, 0.30, 0.17]), np.array([0.05, 0.13, 0.05])
    colour: Array = (old + rng.beta(2, 2) * (young - old)) * rng.uniform(0.75, 1.25)
    return colour


def _backdrop(out: Builder, config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> None:
    """What is behind the plant: other plants, out of focus."""
    s = config.scale
    back = plant.stems[..., 1].max() + s * rng.uniform(0.15, 0.4)
    middle = plant.stems.reshape(-1, 3).mean(0)
    size = 3.0 * np.ptp(plant.stems[..., 0]) + 2.0 * s
    origin = np.array([middle[0] - size / 2, back, middle[2] - size / 2])
    colour = np.array([0.16, 0.26, 0.17]) * rng.uniform(0.5, 1.2)
    tile, thing = size / _TILES, out.thing()
    for i in range(_TILES):
        for j in range(_TILES):
            corner = origin + tile * np.array([i, 0.0, j])
            out.add(
                corner,
                np.array([tile, 0, 0]),
                np.array([0, 0, tile]),
                SQUARE,
                colour,
                texture=Texture.BACKDROP,
                thing=thing,
            )


def _behind(out: Builder, config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> None:
    """Dim leaves between the plant and the backdrop: the row does not end with one plant."""
    low, high = plant.stems.min((0, 1)), plant.stems.max((0, 1))
    s = config.scale
    n = round(60 * float(np.ptp(plant.stems[..., 0])) / s * min(1.0, config.look.foliage_per_m / 20.0))
    for _ in range(n):
        place = rng.uniform(low, high)
        place[1] = high[1] + s * rng.uniform(0.0, 0.15)
        if _hides(place, 0.05 * s, plant.flowers):
            continue
        way, normal = rng.normal(size=3), np.array([0.0, -1.0, 0.6]) + rng.normal(0, 0.5, 3)
        way -= way @ normal * normal / (normal @ normal)
        size = s * rng.uniform(0.05, 0.12)
        _leaflet(out, place, way / np.linalg.norm(way), normal, size, 0.55 * _green(rng), out.thing(), rng)


def _stems(out: Builder, config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> None:
    n_canes = max(4, round(config.plant_width_m / 0.18))
    for i, stem in enumerate(plant.stems):
        thing, radius = out.thing(), config.scale * (0.0045 if i < n_canes else 0.0022)
        mix = rng.random()
        colour = mix * np.array([0.07, 0.22, 0.14]) + (1 - mix) * np.array([0.08, 0.12, 0.22])
        for k in range(len(stem) - 1):
            out.strip(stem[k], stem[k + 1], radius * (1.0 - 0.6 * k / len(stem)), colour, thing=thing)


def _foliage(out: Builder, config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> None:
    """Compound leaves along the stems, none of them in front of a flower."""
    steps = np.diff(plant.stems, axis=1)
    length = np.linalg.norm(steps, axis=2)
    n = round(config.look.foliage_per_m * float(length.sum()) / config.scale)
    which = rng.choice(length.size, n, p=length.ravel() / length.sum())
    stem, part = np.unravel_index(which, length.shape)
    root = plant.stems[stem, part] + rng.random((n, 1)) * steps[stem, part]
    for place in root:
        way = rng.normal([0.0, -0.15, 0.1], [1.0, 0.8, 0.6])
        way /= np.linalg.norm(way)
        size = config.scale * rng.uniform(0.025, 0.055)
        end = place + config.scale * rng.uniform(0.015, 0.05) * way
        if not _hides(end + 0.5 * size * way, 0.9 * size, plant.flowers):
            _compound_leaf(out, place, end, way, size, rng)


def _hides(place: Array, size: float, flowers: Array) -> bool:
    """Whether something of this size would stand between a flower and the arm."""
    offset = flowers - place
    nearer = offset[:, 1] + 0.3 * size
    beside = np.linalg.norm(offset[:, [0, 2]], axis=1)
    return bool(((nearer > 0) & (beside < size + 0.012 + _CORRIDOR * np.maximum(nearer, 0))).any())


def _compound_leaf(out: Builder, root: Array, end: Array, way: Array, size: float, rng: np.random.Generator) -> None:
    """A stalk and three leaflets."""
    thing, colour = out.thing(), _green(rng)
    out.strip(root, end, size * 0.02, colour, thing=thing)
    up = rng.normal([0.0, -0.8, 0.9], 0.45)
    side = np.cross(way, up)
    side /= np.linalg.norm(side)
    normal = np.cross(side, way)
    for turn, share in ((0.0, 1.0), (1.15, 0.8), (-1.15, 0.8)):
        angle = turn + rng.normal(0.0, 0.12)
        droop = rng.normal(-0.15, 0.25)
        along = np.cos(angle) * way + np.sin(angle) * side
        along = np.cos(droop) * along + np.sin(droop) * normal
        _leaflet(out, end, along, normal, size * share * rng.uniform(0.85, 1.15), colour, thing, rng)


def _leaflet(
    out: Builder,
    base: Array,
    along: Array,
    normal: Array,
    size: float,
    colour: Array,
    thing: int,
    rng: np.random.Generator,
) -> None:
    """Two halves, folded at the midrib."""
    across = np.cross(normal, along)
    across /= np.linalg.norm(across)
    up = np.cross(along, across)
    fold = rng.uniform(0.05, 0.45)
    for sign in (1.0, -1.0):
        e2 = sign * 0.36 * size * (np.cos(fold) * across + sign * np.sin(fold) * up)
        out.add(
            base,
            size * along,
            e2,
            half_leaf(rng),
            colour * rng.normal(1.0, 0.05),
            texture=Texture.LEAF,
            translucency=0.35,
            thing=thing,
        )


def _front_leaves(out: Builder, plant: Plant, leaves: Leaves, rng: np.random.Generator) -> None:
    """The large leaves that hide clusters for seconds: ellipses elsewhere, two halves of a leaf here."""
    for j, (axes, radii) in enumerate(zip(leaves.axes, leaves.radii, strict=True)):
        thing, colour, body = out.thing(), _green(rng), len(plant.centroids) + j
        along, across = axes[:, 1] * 2 * radii[1], axes[:, 0] * 1.08 * radii[0]
        base = leaves.centres[0, j] - along / 2
        fold = 0.2 * radii[0] * axes[:, 2]
        for sign in (1.0, -1.0):
            e2 = sign * across + fold
            out.add(
                base - fold / 2,
                along,
                e2,
                half_leaf(rng),
                colour * rng.normal(1.0, 0.05),
                texture=Texture.LEAF,
                translucency=0.35,
                thing=thing,
                body=body,
            )


def _flowers(out: Builder, config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> None:
    """Each flower on a stalk that bends with it."""
    look = config.look
    for index, (place, cluster) in enumerate(zip(plant.flowers, plant.flower_cluster.tolist(), strict=True)):
        outward = place - plant.centroids[cluster]
        outward = outward / max(np.linalg.norm(outward), 1e-6)
        direction = _TO_ARM + look.flower_tilt * (0.6 * outward + 0.6 * rng.normal(size=3))
        direction /= np.linalg.norm(direction)
        radius = config.scale * rng.uniform(look.flower_radius_min_m, look.flower_radius_max_m)
        pink = look.petal_pink * rng.uniform(0.3, 1.0)
        add_flower(out, place, direction, radius, pink, index=index, body=cluster, rng=rng)
        root, thing = plant.attachments[cluster], out.thing()
        bend = (root + place) / 2 - 0.3 * np.linalg.norm(place - root) * direction
        last = place - 0.25 * radius * direction
        t = np.linspace(0.0, 1.0, 6)[:, None]
        curve = (1 - t) ** 2 * root + 2 * t * (1 - t) * bend + t**2 * last
        for k in range(5):
            share = (float(t[k, 0]), float(t[k + 1, 0]))
            out.strip(
                curve[k],
                curve[k + 1],
                0.0007 * config.scale,
                np.array([0.08, 0.3, 0.16]),
                thing=thing,
                body=cluster,
                weights=share,
            )


def _distractors(out: Builder, config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> None:
    points = plant.stems.reshape(-1, 3)
    near = plant.attachments[rng.integers(0, len(plant.attachments), config.look.n_distractors)]
    far = points[rng.integers(0, len(points), config.look.n_distractors)]
    host = np.where(rng.random((config.look.n_distractors, 1)) < 0.5, near, far)
    for place in host + config.scale * rng.normal([0.0, -0.02, 0.0], 0.025, host.shape):
        if not _hides(place, 0.008 * config.scale, plant.flowers):
            add_distractor(out, place, _TO_ARM + rng.normal(0, 0.6, 3), config.scale, rng=rng)
