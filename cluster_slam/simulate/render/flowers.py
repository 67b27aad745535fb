"""Flowers and what is taken for flowers: petals, stamens, sepals; buds, berries and pale leaves."""

from __future__ import annotations

from functools import partial

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.simulate.render.facets import Builder, Texture
from cluster_slam.simulate.render.shapes import SEPAL, disc, frame_about, half_leaf, petal

N_PETALS = 5
_GREEN = np.array([0.06, 0.26, 0.13])
_YELLOW = np.array([0.07, 0.50, 0.62])
_WHITE = np.array([0.62, 0.66, 0.67])
_PINK = np.array([0.52, 0.42, 0.66])


def add_flower(
    out: Builder,
    centre: Array,
    direction: Array,
    radius: float,
    pink: float,
    *,
    index: int,
    body: int,
    rng: np.random.Generator,
) -> None:
    """Petals about the centre, which is the mean of their surface; stamens in front, sepals behind."""
    part = partial(out.add, body=body, thing=out.thing(), flower=index)
    normal, a, b = frame_about(direction, rng)
    cup = rng.uniform(-0.1, 0.5)  # angle by which the petals stand up
    depth = 0.6 * radius * np.sin(cup)  # of the middle below the petals' mean
    middle = centre - depth * normal
    colour = (_WHITE + pink * (_PINK - _WHITE)) * rng.uniform(0.85, 1.05)
    turn = rng.uniform(0, 2 * np.pi)
    n_petals = N_PETALS + int(rng.choice(3, p=[0.1, 0.8, 0.1])) - 1
    for i in range(n_petals):
        angle = turn + 2 * np.pi * i / n_petals + rng.normal(0.0, 0.05)
        out_dir, side = np.cos(angle) * a + np.sin(angle) * b, -np.sin(angle) * a + np.cos(angle) * b
        lift = cup + rng.normal(0.0, 0.16)
        e1 = radius * rng.normal(1.0, 0.04) * (np.cos(lift) * out_dir + np.sin(lift) * normal)
        roll = rng.normal(0.0, 0.12)
        e2 = radius * 4.7 / n_petals * (np.cos(roll) * side + np.sin(roll) * normal)
        origin = middle + rng.normal(0.0, 0.0002) * normal
        tint = colour * rng.normal(1.0, 0.05)
        part(origin, e1, e2, petal(rng), tint, texture=Texture.PETAL, translucency=0.25)
        tip = angle + np.pi / n_petals
        point = 0.8 * radius * (np.cos(tip) * a + np.sin(tip) * b) - 0.1 * radius * normal
        across = 0.35 * radius * (-np.sin(tip) * a + np.cos(tip) * b)
        part(middle - 0.05 * radius * normal, point, across, SEPAL, _GREEN * 1.1)
    size = 2 * radius * rng.uniform(0.26, 0.36)
    yellow = _YELLOW * rng.uniform(0.6, 1.05) + rng.uniform(0.0, 0.12) * np.array([0.3, 0.8, 0.2])
    above = middle + 0.2 * radius * normal
    part(above, size * a, size * b, disc(rng), yellow, texture=Texture.STAMENS)


def add_distractor(out: Builder, place: Array, direction: Array, scale: float, *, rng: np.random.Generator) -> None:
    """A bud, a berry or a pale leaf: no flower, whatever a detector says."""
    kind = rng.integers(3)
    normal, a, b = frame_about(direction, rng)
    thing = out.thing()
    if kind == 0:
        _bud(out, place, normal, a, b, 0.004 * scale * rng.uniform(0.8, 1.4), thing, rng)
    elif kind == 1:
        _berry(out, place, 0.006 * scale * rng.uniform(0.8, 1.4), thing, rng)
    else:
        size = scale * rng.uniform(0.012, 0.03)
        pale = np.array([0.42, 0.50, 0.46]) * rng.uniform(0.7, 1.1)
        for sign in (1.0, -1.0):
            e2 = 0.4 * size * sign * (b + 0.3 * sign * normal)
            out.add(place, size * a, e2, half_leaf(rng), pale, texture=Texture.PALE_LEAF, thing=thing)


def _bud(
    out: Builder, place: Array, normal: Array, a: Array, b: Array, r: float, thing: int, rng: np.random.Generator
) -> None:
    white = rng.random() < 0.5
    for i, height in enumerate((0.0, 0.5, 0.9)):
        size = 2 * r * (1.0, 0.85, 0.5)[i]
        colour = np.array([0.6, 0.68, 0.66]) if white and i else np.array([0.12, 0.33, 0.2])
        out.add(place + height * r * normal, size * a, size * b, disc(rng), colour, thing=thing)


def _berry(out: Builder, place: Array, r: float, thing: int, rng: np.random.Generator) -> None:
    ripe = rng.random()
    green, red = np.array([0.12, 0.42, 0.28]), np.array([0.05, 0.05, 0.42])
    colour = green + (red - green) * ripe
    for _ in range(9):
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        _, a, b = frame_about(way, rng)
        out.add(
            place + 0.75 * r * way,
            1.1 * r * a,
            1.1 * r * b,
            disc(rng, 7),
            colour * rng.uniform(0.8, 1.2),
            texture=Texture.BERRY,
            thing=thing,
        )
