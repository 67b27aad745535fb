"""Sun, sky and shadow: the colour that each pixel sends to the camera, linear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.simulate.render.facets import Facets, Texture
from cluster_slam.simulate.render.raster import Float32, Painted, Placed, _corners, _fill
from cluster_slam.simulate.render.scene import Scene
from cluster_slam.simulate.render.textures import ONE, SIZE, atlas

_MAP_PX = 1400  # longer side of the map of shadows


@dataclass(frozen=True, slots=True, eq=False)
class Shadows:
    """Which thing the sun meets first, on a grid across its rays, with the plant at rest."""

    thing: NDArray[np.int32]  # (h, w) -1 none
    to_map: Float32  # (6, n) u and v on the map, of each facet: at its origin, along e1 and along e2


def cast_shadows(scene: Scene) -> Shadows:
    """The map of shadows of the plant at rest: shadows stay on what they fall on, whatever sways."""
    facets = scene.facets
    right = np.cross(scene.sun, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    basis = np.stack([right, np.cross(scene.sun, right), -scene.sun])  # rows: u, v, along the rays
    origins, e1, e2 = facets.origins @ basis.T, facets.e1 @ basis.T, facets.e2 @ basis.T
    strip = facets.is_strip
    across = np.cross(e1[strip], [0.0, 0.0, 1.0])
    e2[strip] = facets.e2[strip, :1] * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    corners = _corners(facets, Placed(np.arange(len(facets)), origins, e1, e2))
    solid = np.flatnonzero(facets.textures != Texture.BACKDROP)
    low, high = corners[solid, :, :2].min((0, 1)), corners[solid, :, :2].max((0, 1))
    scale = _MAP_PX / (high - low).max()
    order = solid[np.argsort(-corners[solid, :, 2].mean(1), kind="stable")]
    size = np.ceil((high - low) * scale).astype(int) + 1
    number = _fill((corners[order, :, :2] - low) * scale, (int(size[1]), int(size[0])))
    thing = np.append(facets.things[order], -1)[number].astype(np.int32)
    to_map = np.concatenate([(origins[:, :2] - low), e1[:, :2], e2[:, :2]], axis=1).T * scale
    return Shadows(thing, np.ascontiguousarray(to_map, np.float32))


def shade(scene: Scene, shadows: Shadows, kept: Placed, painted: Painted) -> Float32:
    """Linear colours (h, w, 3), blue, green, red."""
    facets = scene.facets
    dark, bright = _facet_colours(scene, kept)
    table = np.concatenate([dark, np.zeros((1, 3)), bright, np.zeros((1, 3))]).astype(np.float32)
    lit = _is_lit(shadows, facets, kept, painted).ravel()
    flat = painted.facet.ravel().astype(np.int64)
    row = np.where(flat < 0, len(kept.index), flat) + (len(kept.index) + 1) * lit
    pattern = _pattern(facets, kept, painted)
    colour: Float32 = table[row] * pattern * np.float32(1.0 / ONE)
    return colour.reshape(*painted.z.shape, 3)


def _facet_colours(scene: Scene, kept: Placed) -> tuple[Array, Array]:
    """Colours (k, 3) of facets in shadow and in the sun: Lambert's law, on leaves and petals also from behind.

    ``kept`` is in the camera's frame, but angles to the sun are taken where the facets rest in the world.
    """
    facets, index = scene.facets, kept.index
    normal = np.cross(facets.e1[index], facets.e2[index])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    cosine = (normal / np.maximum(length, 1e-15)) @ scene.sun
    towards = np.sign((np.cross(kept.e1, kept.e2) * -kept.origins).sum(1))  # +1: the side of the normal is seen
    cosine = cosine * np.where(towards == 0, 1.0, towards)
    through = facets.translucency[index]
    front = np.where(facets.is_strip[index], 0.6, np.maximum(cosine, 0.0))
    sun = front + through * np.maximum(-cosine, 0.0)
    up = 0.75 + 0.25 * (normal / np.maximum(length, 1e-15))[:, 2] * np.where(towards == 0, 1.0, towards)
    albedo = facets.albedo[index]
    dark: Array = albedo * scene.sky_colour * np.where(facets.is_strip[index], 0.8, up)[:, None]
    return dark, dark + albedo * scene.sun_colour * sun[:, None]


def _is_lit(shadows: Shadows, facets: Facets, kept: Placed, painted: Painted) -> NDArray[np.bool_]:
    """Which pixels (h, w) the sun reaches: where the map shows the pixel's own thing."""
    table = np.concatenate([shadows.to_map[:, kept.index], np.zeros((6, 1), np.float32)], axis=1)
    flat, s, t = painted.facet.ravel(), painted.s.ravel(), painted.t.ravel()
    u = table[0][flat] + s * table[2][flat] + t * table[4][flat]
    v = table[1][flat] + s * table[3][flat] + t * table[5][flat]
    height, width = shadows.thing.shape
    column = np.clip(u, 0, width - 1).astype(np.int32)
    row = np.clip(v, 0, height - 1).astype(np.int32)
    own = np.append(facets.things[kept.index], -1).astype(np.int32)[flat]
    first = shadows.thing[row, column]
    far = np.append(facets.textures[kept.index] == Texture.BACKDROP, True)[flat]  # its light is its own
    lit: NDArray[np.bool_] = ((first == own) | (first < 0) | far).reshape(painted.z.shape)
    return lit


def _pattern(facets: Facets, kept: Placed, painted: Painted) -> NDArray[np.uint8]:
    """The atlas at each pixel (h w, 3); patterns across go from -0.5 to 0.5 where outlines do."""
    texture = facets.textures[kept.index]
    centred = facets.outlines[kept.index].min((1, 2)) < -0.2
    base = np.append(texture, 0).astype(np.int32)[painted.facet.ravel()] * (SIZE * SIZE)
    half_t = np.append(np.where(centred, 0.5, 0.0), 0.0).astype(np.float32)
    half_s = np.append(np.where(facets.outlines[kept.index][..., 0].min(1) < -0.2, 0.5, 0.0), 0.0).astype(np.float32)
    flat = painted.facet.ravel()
    column = ((painted.s.ravel() + half_s[flat]) * SIZE).astype(np.int32) & (SIZE - 1)
    row = ((painted.t.ravel() + half_t[flat]) * SIZE).astype(np.int32) & (SIZE - 1)
    pattern: NDArray[np.uint8] = atlas().reshape(-1, 3)[base + row * SIZE + column]
    return pattern
