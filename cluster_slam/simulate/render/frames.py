"""One frame after the other: colour, depth, and where the flowers are in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.records import IntArray
from cluster_slam.sensors.depth import DepthModel, depth_model
from cluster_slam.simulate.render.facets import Facets, Texture
from cluster_slam.simulate.render.lens import photograph
from cluster_slam.simulate.render.light import Shadows, cast_shadows, shade
from cluster_slam.simulate.render.raster import Painted, Placed, Rays, moved, paint, rays_of, seen_from
from cluster_slam.simulate.render.scene import Scene, build_scene
from cluster_slam.simulate.render.stereo import measure
from cluster_slam.simulate.session import Simulated, stream


@dataclass(frozen=True, slots=True, eq=False)
class Boxes:
    """Flowers that one picture shows, hidden ones with what would be seen of them."""

    flowers: IntArray  # (k,)
    centres: Array  # (k, 2) u and v of the flower's centre, pixels
    depths: Array  # (k,) of the centre, m
    sizes: Array  # (k, 2) width and height of a box about the centre, pixels
    visible: Array  # (k,) share of its pixels that is seen


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What the camera gives for one frame, and what is true of it."""

    colour: NDArray[np.uint8]  # (h, w, 3) blue, green, red
    depth: NDArray[np.uint16]  # (h, w) in units of the depth model, 0 none
    boxes: Boxes
    z: NDArray[np.float32]  # (h, w) true depth, m
    is_backdrop: NDArray[np.bool_]  # (h, w) what stands behind all plants


class Renderer:
    """Renders the frames of a simulated recording; frame k is the same whatever was rendered before."""

    def __init__(self, made: Simulated, *, seed: int) -> None:
        self.made, self.seed = made, seed
        self.scene: Scene = build_scene(made.config, made.plant, made.leaves, rng=stream(seed, "looks"))
        self.shadows: Shadows = cast_shadows(self.scene)
        self.rays: Rays = rays_of(made.camera)
        config = made.config
        own = config.depth_sigma if config.look.depth_camera == "generic" else None
        self.depth_model: DepthModel = depth_model(
            config.look.depth_camera, focal_px=config.focal_px, coefficient=None if own is None else max(own, 1e-5)
        )
        self._light = _clouds_over_time(made, stream(seed, "clouds"))

    def frame(self, k: int) -> Picture:
        """The picture of frame k."""
        made, look = self.made, self.made.config.look
        rng = stream(self.seed, f"frame {k}")
        facets = self.scene.facets
        T_camera_world = inverse(made.truth.T_world_camera[k])  # type: ignore[index]
        world = self._placed(k)
        kept, painted = paint(facets, seen_from(facets, world, T_camera_world), self.rays)
        linear = shade(self.scene, self.shadows, kept, painted)
        colour = photograph(linear, look, float(self._light[k]), self._flow(k), rng)
        depth = measure(painted.z, self.depth_model, colour, look.holes, rng)
        behind = np.append(facets.textures[kept.index] == Texture.BACKDROP, True)[painted.facet]
        return Picture(colour, depth, self._boxes(k, T_camera_world, world, kept, painted), painted.z, behind)

    def _placed(self, k: int) -> Placed:
        motion, leaves = self.made.motion, self.made.leaves
        displacements = np.concatenate([motion.displacements[k], leaves.centres[k] - leaves.centres[0]])
        rotations = None if motion.rotations is None else motion.rotations[k]
        return moved(self.scene.facets, self.scene.centroids, displacements, rotations)

    def _flow(self, k: int) -> Array:
        """How far the middle of the plant moves in the picture during an exposure, pixels."""
        made = self.made
        T = made.truth.T_world_camera
        if T is None or len(T) < 2:
            return np.zeros(2)
        i = min(k, len(T) - 2)
        middle = transform(T[i], np.array([0.0, 0.0, made.config.scale * made.config.distance_min_m]))
        pixels = made.camera.project(transform(inverse(T[i : i + 2]), np.tile(middle, (2, 1))))
        flow: Array = (pixels[1] - pixels[0]) * min(1.0, made.config.look.exposure_s * made.config.fps)
        return flow

    def _boxes(self, k: int, T_camera_world: Array, world: Placed, kept: Placed, painted: Painted) -> Boxes:
        """Where flowers are, and which share of each is seen."""
        facets, camera = self.scene.facets, self.made.camera
        centres = transform(T_camera_world, self.made.flower_positions[k])
        petals = np.flatnonzero((facets.flowers >= 0) & (facets.textures == Texture.PETAL))
        corners = _world_corners(facets, world, petals)
        points = transform(T_camera_world, corners.reshape(-1, 3))
        ahead = np.flatnonzero(centres[:, 2] > 0.05)
        pixels = camera.project(np.column_stack([points[:, :2], np.maximum(points[:, 2], 0.03)]))
        pixels = pixels.reshape(len(petals), -1, 2)
        middle = np.full((len(centres), 2), -1e6)
        middle[ahead] = camera.project(centres[ahead])
        sizes = np.zeros((len(centres), 2))
        owner = facets.flowers[petals]
        for j in range(len(centres)):
            mine = pixels[owner == j].reshape(-1, 2)
            sizes[j] = np.ptp(mine, axis=0)
        height, width = painted.z.shape
        inside = (middle > -0.5).all(1) & (middle[:, 0] < width - 0.5) & (middle[:, 1] < height - 0.5)
        kept_flowers = np.flatnonzero(inside & (centres[:, 2] > 0.05))
        flower_of = np.append(facets.flowers[kept.index], -1)[painted.facet]
        seen = np.bincount(flower_of[flower_of >= 0], minlength=len(centres))
        whole = np.array([_area(pixels[owner == j], middle[j], sizes[j]) for j in kept_flowers])
        share = seen[kept_flowers] / np.maximum(whole, 1)
        return Boxes(
            kept_flowers, middle[kept_flowers], centres[kept_flowers, 2], sizes[kept_flowers], np.minimum(share, 1.0)
        )


def _world_corners(facets: Facets, world: Placed, which: IntArray) -> Array:
    outline = facets.outlines[which]
    corners: Array = (
        world.origins[which, None] + outline[..., :1] * world.e1[which, None] + outline[..., 1:] * world.e2[which, None]
    )
    return corners


def _area(petals: Array, middle: Array, size: Array) -> int:
    """Pixels that petals (k, n, 2) would cover, were nothing in front."""
    import cv2

    low = np.floor(middle - size).astype(int) - 2
    side = np.ceil(2 * size).astype(int) + 5
    if side.max() > 4000 or not len(petals):
        return 0
    canvas = np.zeros((int(side[1]), int(side[0])), np.uint8)
    fixed = np.rint((petals - low) * 8).astype(np.int32)
    for outline in fixed:
        cv2.fillPoly(canvas, [outline], 1, cv2.LINE_8, 3)
    return int(canvas.sum())


def _clouds_over_time(made: Simulated, rng: np.random.Generator) -> Array:
    """The light (n,) of each frame, about 1, that changes within seconds."""
    times = made.session.stamps - made.session.stamps[0]
    phase, hz = rng.uniform(0, 2 * np.pi, 3), np.array([0.05, 0.13, 0.31])
    waves = np.sin(2 * np.pi * hz * times[:, None] + phase).sum(1) / np.sqrt(1.5)
    light: Array = np.exp(made.config.look.vary_light * waves)
    return light
