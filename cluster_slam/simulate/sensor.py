"""What the camera detects: flowers in view and not hidden, with errors, and things that are no flowers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.records import CLUTTER, IntArray
from cluster_slam.sensors.camera import Camera
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.leaves import Leaves, hidden_by

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Detections as the sensor gives them, in the order of the frames."""

    frame: IntArray  # (m,)
    flower: IntArray  # (m,) index of the flower, -1 = clutter
    pixels: Array  # (m, 3) u, v in pixels and depth in m


def camera_of(config: SimulateConfig) -> Camera:
    """The camera: pixel centres at whole numbers, the optical axis in the middle of the image."""
    width, height = config.image_width_px, config.image_height_px
    distortion = np.zeros(8)
    distortion[0] = config.distortion_k1
    return Camera(config.focal_px, config.focal_px, (width - 1) / 2, (height - 1) / 2, distortion, width, height)


def project(camera: Camera, points: Array) -> Array:
    """u, v (px) and depth (m) (m, 3) of points (m, 3) in the camera frame."""
    return np.column_stack([camera.project(points), points[:, 2]])


def in_view(config: SimulateConfig, points: Array) -> BoolArray:
    """Which points (m, 3) of the camera frame lie in the image and within the depth range."""
    inside = (points[:, 2] > config.depth_min_m) & (points[:, 2] < config.depth_max_m * config.scale)
    inside[inside] = in_image(config, camera_of(config).project(points[inside]))
    return inside


def in_image(config: SimulateConfig, pixels: Array) -> BoolArray:
    """Which pixels (m, 2 or more) lie in the image."""
    u, v = pixels[:, 0], pixels[:, 1]
    inside: BoolArray = (u >= 0) & (u <= config.image_width_px - 1) & (v >= 0) & (v <= config.image_height_px - 1)
    return inside


def visible_flowers(config: SimulateConfig, T_world_camera: Array, flowers: Array, leaves: Leaves) -> BoolArray:
    """Which flowers (n, f) are in view and not behind a leaf."""
    points = transform(inverse(T_world_camera)[:, None], flowers)
    visible = in_view(config, points.reshape(-1, 3)).reshape(flowers.shape[:2])
    frame, flower = np.nonzero(visible)
    hidden = hidden_by(leaves, frame, T_world_camera[frame, :3, 3], flowers[frame, flower])
    visible[frame[hidden], flower[hidden]] = False
    return visible


def detect(
    config: SimulateConfig,
    T_world_camera: Array,
    flowers: Array,
    visible: BoolArray,
    leaves: Leaves,
    *,
    rng: np.random.Generator,
) -> Detections:
    """Detections of flowers (n, f, 3), and clutter; shuffled within each frame."""
    miss_rng, noise_rng, clutter_rng, order_rng = rng.spawn(4)
    seen = visible & (miss_rng.random(visible.shape) >= config.miss_rate)
    frame, flower = np.nonzero(seen)
    points = transform(inverse(T_world_camera)[frame], flowers[frame, flower])
    pixels = project(camera_of(config), points)
    pixels += _errors(config, seen, pixels[:, 2], noise_rng)
    good = in_image(config, pixels) & (pixels[:, 2] > config.depth_min_m / 2)
    frame, flower, pixels = frame[good], flower[good], pixels[good]
    false_frame, false_pixels = _clutter(config, T_world_camera, flowers, visible, leaves, clutter_rng)
    frame = np.concatenate([frame, false_frame])
    order = np.lexsort([order_rng.random(len(frame)), frame])
    flower = np.concatenate([flower, np.full(len(false_frame), CLUTTER)])
    return Detections(frame[order], flower[order], np.concatenate([pixels, false_pixels])[order])


def _errors(
    config: SimulateConfig,
    seen: BoolArray,
    depth: Array,
    rng: np.random.Generator,
) -> Array:
    """Errors (m, 3) of u, v and depth; a share of them ``tail_factor`` times as large."""
    normal = rng.normal(size=(*seen.shape, 3))[seen]
    is_tail = rng.random(seen.shape)[seen] < config.tail_share
    normal[is_tail] *= config.tail_factor
    sigma_px = np.full(len(depth), config.pixel_sigma)
    errors: Array = normal * np.stack([sigma_px, sigma_px, config.depth_sigma * depth**2], axis=1)
    return errors


def _clutter(
    config: SimulateConfig,
    T_world_camera: Array,
    flowers: Array,
    visible: BoolArray,
    leaves: Leaves,
    rng: np.random.Generator,
) -> tuple[IntArray, Array]:
    """Frames (k,) and pixels (k, 3) of false detections: anywhere in view, near flowers, or for a while on a leaf."""
    n = len(T_world_camera)
    white_rng, near_rng, stay_rng = rng.spawn(3)
    rate = config.clutter_per_frame * (1 - config.clutter_persistent_share)
    frame = np.repeat(np.arange(n), white_rng.poisson(rate, n))
    pixels = _anywhere(config, len(frame), white_rng)
    is_near = white_rng.random(len(frame)) < 0.5
    pixels[is_near] = _near(config, T_world_camera, flowers, visible, frame[is_near], pixels[is_near], near_rng)
    stay_frame, stay_pixels = _staying(config, T_world_camera, flowers, leaves, stay_rng)
    return np.concatenate([frame, stay_frame]), np.concatenate([pixels, stay_pixels])


def _anywhere(config: SimulateConfig, n: int, rng: np.random.Generator) -> Array:
    """Pixels (n, 3), uniform in the image, depths where a plant may be."""
    low, high = 0.6 * config.distance_min_m * config.scale, 1.4 * config.distance_max_m * config.scale
    return rng.uniform([0.0, 0.0, low], [config.image_width_px - 1, config.image_height_px - 1, high], (n, 3))


def _near(
    config: SimulateConfig,
    T_world_camera: Array,
    flowers: Array,
    visible: BoolArray,
    frame: IntArray,
    fallback: Array,
    rng: np.random.Generator,
) -> Array:
    """Pixels (k, 3) of points 4 cm (one sigma an axis) from a visible flower of their frame, where there is one."""
    place = rng.random((len(frame), flowers.shape[1])) * visible[frame]
    flower = place.argmax(1)
    points = flowers[frame, flower] + rng.normal(0.0, 0.04 * config.scale, (len(frame), 3))
    points = transform(inverse(T_world_camera)[frame], points)
    good = in_view(config, points) & visible[frame, flower]
    pixels = fallback.copy()
    pixels[good] = project(camera_of(config), points[good])
    return pixels


def _staying(
    config: SimulateConfig, T_world_camera: Array, flowers: Array, leaves: Leaves, rng: np.random.Generator
) -> tuple[IntArray, Array]:
    """False detections that stay for 2 to 8 frames: at a point of a leaf, or of the plant where there are no leaves."""
    n = len(T_world_camera)
    rate = config.clutter_per_frame * config.clutter_persistent_share / 5.0
    start = np.repeat(np.arange(n), rng.poisson(rate, n))
    life = rng.integers(2, 9, len(start))
    frame = np.repeat(start, life) + np.concatenate([np.arange(k) for k in life] + [np.empty(0, np.int64)])
    which = np.repeat(rng.integers(0, 2**31, len(start)), life)
    offset = np.repeat(rng.normal(0.0, 0.03 * config.scale, (len(start), 3)), life, axis=0)
    noise = rng.normal(size=(len(frame), 3))
    frame, which, offset, noise = (a[frame < n] for a in (frame, which, offset, noise))
    hosts = leaves.centres if leaves.centres.shape[1] else flowers
    points = hosts[frame, which % hosts.shape[1]] + offset
    points = transform(inverse(T_world_camera)[frame], points)
    good = in_view(config, points)
    pixels = project(camera_of(config), points[good])
    sigma = np.stack([np.full(len(pixels), config.pixel_sigma)] * 2 + [config.depth_sigma * pixels[:, 2] ** 2], axis=1)
    pixels = pixels + noise[good] * sigma
    inside = in_image(config, pixels)
    return frame[good][inside], pixels[inside]
