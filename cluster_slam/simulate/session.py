"""One simulated recording: the world, the arm, the camera, and what is known about them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cluster_slam.errors import ConfigError
from cluster_slam.geometry import Array
from cluster_slam.io.session_writer import Moments, check_session_output, write_session
from cluster_slam.lift import lift
from cluster_slam.records import CLUTTER, Observations, Session, StatedNoise, Truth
from cluster_slam.sensors.camera import Camera
from cluster_slam.simulate.camera_path import HandEye, camera_path, measured_poses, mount_camera
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.leaves import Leaves, grow_leaves
from cluster_slam.simulate.motion import Motion, flower_positions, move
from cluster_slam.simulate.plant import Plant, grow_plant
from cluster_slam.simulate.sensor import Detections, camera_of, detect, visible_flowers

_START_S = 1_777_888_800.0  # 2026-05-04 10:00 UTC


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """A recording and all that is true about it."""

    config: SimulateConfig
    session: Session
    truth: Truth
    flower_positions: Array  # (n, f, 3) world, at each frame; flower ids are 0 to f - 1
    visible: NDArray[np.bool_]  # (n, f) in view and not hidden
    plant: Plant
    motion: Motion
    leaves: Leaves
    hand_eye: HandEye
    camera: Camera


def simulate(
    config: SimulateConfig, out: Path, *, seed: int, progress: Callable[[str, float], None] | None = None
) -> None:
    """Write a simulated session with its truth into the folder ``out``, whole or not at all.

    Level 1 is rendered; ``progress`` is then called with the stage in words and a fraction 0..1.

    Raises
    ------
    ConfigError
        The plant does not fit its own spacings.
    OutputError
        ``out`` holds something that is no earlier session, or cannot be written.
    """
    check_session_output(out)
    made = simulate_session(config, seed=seed)
    frames = np.unique(np.linspace(0, made.session.n_frames - 1, 10).round().astype(np.int64))
    moments = Moments(frames, made.flower_positions[frames])
    if config.level == 1:
        from cluster_slam.simulate.render.session import write_rendered

        write_rendered(out, made, moments, seed=seed, progress=progress)
        return
    write_session(out, made.session, made.truth, camera=made.camera, moments=moments)


def simulate_session(
    config: SimulateConfig, *, seed: int, plant: Plant | None = None, visited: Plant | None = None
) -> Simulated:
    """Simulate a recording in memory. The same configuration and seed give the same arrays in any process.

    ``plant`` (None: one is grown) is recorded by a camera that sweeps past ``visited`` (None: all of the plant).

    Raises
    ------
    ConfigError
        The plant does not fit its own spacings, or the seed is negative.
    """
    if seed < 0:
        raise ConfigError(f"the seed must be a whole number from 0, not {seed}")
    times = np.arange(config.n_frames) / config.fps
    plant = plant or grow_plant(config, rng=stream(seed, "plant"))
    motion = move(config, plant, times, rng=stream(seed, "motion"))
    flowers = flower_positions(plant, motion)
    T_world_camera = camera_path(config, visited or plant, times, rng=stream(seed, "path"))
    hand_eye = mount_camera(config, rng=stream(seed, "mount"))
    leaves = grow_leaves(config, plant, times, rng=stream(seed, "leaves"))
    visible = visible_flowers(config, T_world_camera, flowers, leaves)
    detections = detect(config, T_world_camera, flowers, visible, leaves, rng=stream(seed, "detections"))
    observations, noise = _observe(config, detections, rng=stream(seed, "scores"))
    session = Session(
        id=f"simulated-{seed}",
        stamps=np.round(_START_S + times, 6),
        poses=measured_poses(config, T_world_camera, hand_eye, rng=stream(seed, "poses")),
        pose_frame=config.pose_frame,
        pose_error=config.pose_error,
        T_flange_camera=hand_eye.measured if config.pose_frame == "T_world_flange" else None,
        noise=noise,
        observations=observations,
        plant=f"simulated-{seed}",
        level=config.level,
    )
    truth = _truth(plant, T_world_camera, detections)
    return Simulated(config, session, truth, flowers, visible, plant, motion, leaves, hand_eye, camera_of(config))


def stream(seed: int, part: str) -> np.random.Generator:
    """One stream a part of the world, so that an option of one part does not reshuffle the others."""
    return np.random.default_rng([seed, *part.encode()])


def _truth(plant: Plant, T_world_camera: Array, detections: Detections) -> Truth:
    cluster = plant.flower_cluster
    is_true = detections.flower != CLUTTER
    return Truth(
        T_world_camera=T_world_camera,
        flower_ids=detections.flower,
        cluster_ids=np.where(is_true, cluster[detections.flower], CLUTTER),
        rest_flower_ids=np.arange(len(cluster)),
        rest_cluster_ids=cluster,
        rest_positions=plant.flowers,
    )


def _observe(
    config: SimulateConfig, detections: Detections, *, rng: np.random.Generator
) -> tuple[Observations, StatedNoise]:
    """Camera-frame points with the covariances that are stated, and the session's stated noise."""
    pixels = detections.pixels
    factor = config.stated_sigma_factor
    pixel, depth = factor * max(config.pixel_sigma, 0.01), factor * max(config.depth_sigma, 1e-5)
    points, covs = lift(
        camera_of(config), pixels[:, :2], pixels[:, 2], convention="z", sigma_px=pixel, depth_coefficient=depth
    )
    flower = float(np.sqrt(covs.trace(axis1=1, axis2=2).mean() / 3)) if len(covs) else 0.005 * factor
    has_covariance = config.with_covariances or config.level == 2
    if not has_covariance:
        covs = np.tile(flower**2 * np.eye(3), (len(covs), 1, 1))
    scores = np.full(len(pixels), np.nan)
    if config.with_scores:
        scores = np.where(detections.flower == CLUTTER, rng.beta(2, 3, len(pixels)), rng.beta(6, 2, len(pixels)))
    noise = StatedNoise(
        pose_translation=factor * max(config.pose_translation, 1e-5),
        pose_rotation=factor * max(config.pose_rotation, 1e-5),
        odometry_translation=factor * config.odometry_translation,
        odometry_rotation=factor * config.odometry_rotation,
        hand_eye_translation=factor * max(config.hand_eye_translation, 1e-3),
        hand_eye_rotation=factor * max(config.hand_eye_rotation, 1e-3),
        flower=flower,
        pixel=pixel,
        depth=depth,
    )
    return Observations(detections.frame, points, covs, scores, has_covariance), noise
