"""Flat pieces in space: what all that is rendered is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

N_CORNERS = 12  # of an outline; outlines of fewer corners repeat the last one


class Texture(IntEnum):
    """Patterns of the atlas."""

    PLAIN = 0
    LEAF = 1
    PETAL = 2
    STEM = 3
    STAMENS = 4
    BACKDROP = 5
    BERRY = 6
    PALE_LEAF = 7


@dataclass(frozen=True, slots=True, eq=False)
class Facets:
    """Flat outlines at rest in the world; a point of one is ``origin + s e1 + t e2``.

    A strip (a piece of a stem) is as wide from wherever it is seen: its e2 is only a length, along x, and is turned
    to the viewer.
    """

    origins: Array  # (n, 3)
    e1: Array  # (n, 3)
    e2: Array  # (n, 3)
    outlines: Array  # (n, N_CORNERS, 2) s and t
    albedo: Array  # (n, 3) blue, green, red, linear
    textures: IntArray  # (n,) of Texture
    translucency: Array  # (n,) share of the light that comes through
    bodies: IntArray  # (n,) what it moves with: clusters first, then leaves; -1 nothing
    weights: Array  # (n, 2) share of the body's movement, at s = 0 and at s = 1
    things: IntArray  # (n,) what it is a part of: parts throw no shadow on each other
    flowers: IntArray  # (n,) index of the flower, -1 none
    is_strip: BoolArray  # (n,)

    def __len__(self) -> int:
        return len(self.origins)


@dataclass(slots=True, eq=False)
class Builder:
    """Collects facets one by one."""

    rows: list[tuple[Array, Array, Array, Array, Array, int, float, int, tuple[float, float], int, int, bool]] = field(
        default_factory=list
    )
    n_things: int = 0

    def thing(self) -> int:
        """A new thing, for the facets that follow."""
        self.n_things += 1
        return self.n_things - 1

    def add(
        self,
        origin: Array,
        e1: Array,
        e2: Array,
        outline: Array,
        albedo: Array,
        *,
        texture: Texture = Texture.PLAIN,
        translucency: float = 0.0,
        body: int = -1,
        weights: tuple[float, float] = (1.0, 1.0),
        thing: int = -1,
        flower: int = -1,
        is_strip: bool = False,
    ) -> None:
        """One facet more."""
        padded = np.concatenate([outline, np.tile(outline[-1:], (N_CORNERS - len(outline), 1))])
        owner = thing if thing >= 0 else self.thing()
        self.rows.append(
            (origin, e1, e2, padded, albedo, int(texture), translucency, body, weights, owner, flower, is_strip)
        )

    def strip(
        self,
        start: Array,
        end: Array,
        radius: float,
        albedo: Array,
        *,
        thing: int,
        body: int = -1,
        weights: tuple[float, float] = (1.0, 1.0),
    ) -> None:
        """A piece of a stem."""
        wide = np.array([2.0 * radius, 0.0, 0.0])
        self.add(
            start,
            end - start,
            wide,
            STRIP,
            albedo,
            texture=Texture.STEM,
            body=body,
            weights=weights,
            thing=thing,
            is_strip=True,
        )

    def build(self) -> Facets:
        """All of them as arrays."""
        columns = [np.array(column) for column in zip(*self.rows, strict=True)]
        return Facets(*columns)


STRIP = np.array([[-0.02, -0.5], [1.02, -0.5], [1.02, 0.5], [-0.02, 0.5]])
