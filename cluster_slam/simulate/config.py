"""Options of the simulated world, and the named worlds (presets)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from math import inf, pi
from typing import Any

from cluster_slam.errors import ConfigError
from cluster_slam.records import PoseError, PoseFrame
from cluster_slam.simulate.render.config import LookConfig


@dataclass(frozen=True, slots=True)
class SimulateConfig:
    """One world and one recording of it. The defaults are the preset ``moderate``.

    ``scale`` multiplies every length of the plant, the leaves and the camera's distance; what the instruments and the
    touches do (noise, hand-eye error, ``sway_m``) stays as it is.
    """

    # the plant
    n_clusters: int = 12  # clusters of two flowers or more
    flowers_min: int = 3  # flowers of the smallest cluster
    flowers_max: int = 6  # flowers of the largest cluster; small ones are commoner
    loose_share: float = 0.04  # of all flowers: single ones, each a cluster of one
    cluster_spacing_m: float = 0.13  # least distance of two centroids
    neighbour_share: float = 0.4  # of clusters: set within 1.3 spacings of another, as along a real cane
    cluster_radius_min_m: float = 0.02  # the farthest flower of the tightest cluster from its centroid
    cluster_radius_max_m: float = 0.05  # and of the widest
    flower_spacing_m: float = 0.012  # least distance of any two flowers: they are solid
    plant_width_m: float = 1.5  # along the row
    plant_height_m: float = 1.0
    plant_depth_m: float = 0.35  # across the row
    scale: float = 1.0  # times every length of plant, leaves and camera distance

    # the recording
    duration_s: float = 30.0
    fps: float = 30.0  # frames a second
    distance_min_m: float = 0.4  # of the camera from the point it looks at
    distance_max_m: float = 0.7
    max_speed_m_per_s: float = 0.5  # of the camera: what a UR5 does safely beside a plant
    turn_rad: float = 0.6  # amplitude of azimuth and roll; elevation 0.6 times this. 0: pure translation
    image_width_px: int = 848
    image_height_px: int = 480
    focal_px: float = 430.0  # as a D405 or D435 at this size
    distortion_k1: float = 0.0  # first radial coefficient, of pincushion kind; it matters at level 2 only
    depth_min_m: float = 0.1  # nearer flowers are not detected
    depth_max_m: float = 1.0  # farther flowers are not detected (times scale)

    # poses
    pose_frame: PoseFrame = "T_world_flange"
    pose_error: PoseError = "absolute"
    pose_translation: float = 0.001  # m, one sigma an axis and frame (odometry: of each step)
    pose_rotation: float = 0.002  # rad
    odometry_translation: float = 0.05  # m per m travelled, with pose_error = "odometry"
    odometry_rotation: float = 0.05  # rad per rad turned
    hand_eye_translation: float = 0.004  # m, norm of the error of the measured T_flange_camera
    hand_eye_rotation: float = 0.5 * pi / 180  # rad

    # detections
    level: int = 3  # 1: pictures; 2: detections.csv and camera.yaml; 3: flowers.csv
    pixel_sigma: float = 1.0  # px, of u and of v
    depth_sigma: float = 0.006  # sigma of the depth = depth_sigma * z^2, z in m
    stated_sigma_factor: float = 1.0  # stated sigmas over true ones
    tail_share: float = 0.0  # of the detections: errors tail_factor times as large, and nobody says so
    tail_factor: float = 5.0
    miss_rate: float = 0.1  # of the flowers in view and not hidden
    n_leaves: int = 6  # each hides what is behind it, often a whole cluster for seconds
    clutter_per_frame: float = 0.2  # mean number of false detections
    clutter_persistent_share: float = 0.1  # of the clutter: stays for 2 to 8 frames at one place
    with_covariances: bool = True  # level 3: covariance columns
    with_scores: bool = False

    # motion of the plant
    sway_m: float = 0.02  # largest displacement after touches
    touches_per_minute: float = 8.0  # wind, insects, the arm itself
    touch_reach_m: float = 0.2  # sigma of a touch's effect over distance
    sway_frequency_min_hz: float = 0.5
    sway_frequency_max_hz: float = 3.0
    damping_min: float = 0.05  # ratio to critical
    damping_max: float = 0.15
    sway_rotation_rad: float = 0.0  # turn of a cluster at the largest displacement
    ambient_sway_m: float = 0.0003  # rms an axis, at all times
    growth_m_per_s: float = 0.0  # slow drift of each cluster from its place at the start

    look: LookConfig = field(default_factory=LookConfig)  # level 1: how the plant looks and the camera errs

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            if not isinstance(value, str) and not is_dataclass(value) and not 0 <= value < inf:
                raise ConfigError(f"{name} must be a number from 0, not {value}")
        for name in _POSITIVE:
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be greater than 0, not {getattr(self, name)}")
        for name in _SHARES:
            if getattr(self, name) > 1:
                raise ConfigError(f"{name} must lie within 0 and 1, not {getattr(self, name)}")
        for low, high in _RANGES:
            if getattr(self, low) > getattr(self, high):
                raise ConfigError(f"{low} = {getattr(self, low)} must not exceed {high} = {getattr(self, high)}")
        for name, allowed in _CHOICES:
            if getattr(self, name) not in allowed:
                raise ConfigError(f"{name} must be one of {allowed}, not {getattr(self, name)!r}")

    @property
    def n_frames(self) -> int:
        return max(1, round(self.duration_s * self.fps))


_POSITIVE = (
    *("n_clusters", "flowers_min", "scale", "plant_width_m", "plant_height_m", "touch_reach_m"),
    *("duration_s", "fps", "distance_min_m", "max_speed_m_per_s", "focal_px", "image_width_px", "image_height_px"),
    *("sway_frequency_min_hz", "stated_sigma_factor"),
)
_SHARES = ("neighbour_share", "tail_share", "miss_rate", "clutter_persistent_share", "damping_max", "loose_share")
_RANGES = (
    ("flowers_min", "flowers_max"),
    ("cluster_radius_min_m", "cluster_radius_max_m"),
    ("distance_min_m", "distance_max_m"),
    ("depth_min_m", "depth_max_m"),
    ("sway_frequency_min_hz", "sway_frequency_max_hz"),
    ("damping_min", "damping_max"),
)
_CHOICES: tuple[tuple[str, tuple[str | int, ...]], ...] = (
    ("pose_frame", ("T_world_flange", "T_world_camera")),
    ("pose_error", ("absolute", "odometry")),
    ("level", (1, 2, 3)),
)

MODERATE = SimulateConfig()
HARD = replace(
    MODERATE,
    n_clusters=40,
    cluster_spacing_m=0.08,
    cluster_radius_max_m=0.045,
    plant_width_m=1.1,
    plant_height_m=0.8,
    duration_s=60.0,
    sway_m=0.05,
    touches_per_minute=20.0,
    miss_rate=0.25,
    n_leaves=25,
    clutter_per_frame=2.0,
    hand_eye_translation=0.005,
)
SAMPLE = replace(MODERATE, n_clusters=5, duration_s=10.0, fps=15.0, touches_per_minute=12.0, n_leaves=1)

_STRANGE: dict[str, dict[str, Any]] = {
    "sigma-half": {"stated_sigma_factor": 0.5},
    "sigma-double": {"stated_sigma_factor": 2.0},
    "tails": {"tail_share": 0.03, "tail_factor": 5.0},
    "turning": {"sway_rotation_rad": 0.3},
    "slow-sway": {"sway_frequency_min_hz": 0.3, "sway_frequency_max_hz": 0.6},
    "wide-sway": {"sway_frequency_min_hz": 0.3, "sway_frequency_max_hz": 3.0},
    "fast-sway": {"sway_frequency_min_hz": 2.5, "sway_frequency_max_hz": 3.0},
    "fps5": {"fps": 5.0},
    "fps15": {"fps": 15.0},
    "fps60": {"fps": 60.0},
    "small": {"scale": 0.5},
    "large": {"scale": 3.0},
    "tiny": {"n_clusters": 1, "flowers_min": 3, "flowers_max": 3, "loose_share": 0.0},
    "odometry": {
        "pose_error": "odometry",
        "pose_frame": "T_world_camera",
        "pose_translation": 0.0005,
        "pose_rotation": 0.0005,
    },
    "pixels": {"level": 2},
    "images": {"level": 1},
    "bare": {"with_covariances": False},
    "translation": {"turn_rad": 0.0},
    "long": {"duration_s": 5000 / 30},
    "longest": {"duration_s": 20000 / 30},
    "huge": {"n_clusters": 300, "plant_width_m": 8.0},
}


def _presets() -> dict[str, SimulateConfig]:
    presets = {"moderate": MODERATE, "hard": HARD, "sample": SAMPLE}
    for base_name, base in (("moderate", MODERATE), ("hard", HARD)):
        for name, changes in _STRANGE.items():
            presets[f"{base_name}-{name}"] = replace(base, **changes)
    return presets


PRESETS: dict[str, SimulateConfig] = _presets()
