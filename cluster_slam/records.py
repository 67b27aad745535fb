"""What passes between the stages: frozen records, validated once where they are made.

Shapes: n frames, m observations, f flowers, c clusters. Units: metres, radians, seconds. Arrays are float64 unless
said otherwise and are never modified in place.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
PoseFrame = Literal["T_world_camera", "T_world_flange"]
PoseError = Literal["absolute", "odometry"]
State = Literal["tentative", "confirmed", "lost"]
CLUTTER = -1  # the id of an observation that is taken for a false one


class RejectReason(IntEnum):
    """Why an observation has no landmark, or that it has one."""

    ACCEPTED = 0
    POSITION_GATE = 1  # no landmark predicted within the gate
    DESCRIPTOR_GATE = 2  # the cluster's descriptor does not fit
    GEOMETRY_GATE = 3  # the members' geometry does not fit
    TAKEN = 4  # another observation of the frame fits the landmark better
    UNCONFIRMED = 5  # seen too rarely for a landmark
    OUTLIER = 6  # assigned, but found inconsistent when all was smoothed


@dataclass(frozen=True, slots=True)
class StatedNoise:
    """Standard deviations that a session states (``[noise]``); None where it does not state them."""

    pose_translation: float = 0.001  # m
    pose_rotation: float = 0.002  # rad
    odometry_translation: float = 0.05  # m per m travelled
    odometry_rotation: float = 0.1  # rad per rad turned
    hand_eye_translation: float = 0.005  # m
    hand_eye_rotation: float = 0.01  # rad
    flower: float = 0.005  # m, isotropic, where no covariance is given
    pixel: float = 1.0  # px, of u and of v
    depth: float = 0.006  # sigma of the depth = depth * z^2, z in m


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Flowers as single frames saw them, in the order of the input's rows."""

    frame: IntArray  # (m,) index of the frame
    points: Array  # (m, 3) camera frame, m
    covs: Array  # (m, 3, 3) camera frame, m^2
    scores: Array  # (m,) detector's score, NaN where there is none
    has_covariance: bool = True  # False where covs come from StatedNoise.flower alone

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True, eq=False)
class ImageDetections:
    """Flowers in one picture, as a detector found them: boxes, best first."""

    centres: Array  # (k, 2) u and v of the box's middle, pixels
    sizes: Array  # (k, 2) width and height, pixels
    scores: Array  # (k,) 0 to 1

    def __len__(self) -> int:
        return len(self.scores)


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One instant as it arrives live: when, the pose that the robot or the odometry gave, and what was seen.

    Stamps are those of the camera's clock. Not validated: what a live source yields may be late, doubled or broken,
    and whoever takes frames in says which he refuses.
    """

    stamp: float  # s
    pose: Array  # (4, 4) T_world_flange or T_world_camera, whichever the session's ``pose_frame`` names
    points: Array  # (q, 3) camera frame, m
    covs: Array  # (q, 3, 3) camera frame, m^2
    scores: Array | None = None  # (q,) detector's score, NaN where there is none

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth, for evaluation and simulation only. Any part may be missing (None)."""

    T_world_camera: Array | None = None  # (n, 4, 4)
    flower_ids: IntArray | None = None  # (m,) -1 = false detection
    cluster_ids: IntArray | None = None  # (m,)
    rest_flower_ids: IntArray | None = None  # (f,)
    rest_cluster_ids: IntArray | None = None  # (f,)
    rest_positions: Array | None = None  # (f, 3) world
    T_map_world: Array | None = None  # (4, 4)
    T_flange_camera: Array | None = None  # (4, 4) true hand-eye transform, where a simulation knows it


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """One recording: poses as they were given, and flowers in the camera frame."""

    id: str
    stamps: Array  # (n,) s, strictly increasing
    poses: Array  # (n, 4, 4) of the frame named by pose_frame
    pose_frame: PoseFrame
    pose_error: PoseError
    T_flange_camera: Array | None  # (4, 4) as measured; None where poses are the camera's
    noise: StatedNoise
    observations: Observations
    plant: str | None = None
    path: Path | None = None
    level: int = 3
    warnings: tuple[str, ...] = ()

    @property
    def n_frames(self) -> int:
        return len(self.stamps)

    @property
    def T_world_camera(self) -> Array:
        """Camera poses (n, 4, 4) as the given poses and the measured hand-eye transform have them."""
        return self.poses if self.T_flange_camera is None else self.poses @ self.T_flange_camera


@dataclass(frozen=True, slots=True, eq=False)
class Flowers:
    """Flowers at rest in the world."""

    ids: IntArray  # (f,) >= 0, increasing
    cluster_ids: IntArray  # (f,)
    positions: Array  # (f, 3)
    covs: Array  # (f, 3, 3)
    first_seen: Array  # (f,) s
    last_seen: Array  # (f,) s
    n_observations: IntArray  # (f,)

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Clusters at rest in the world: the centroid is the unweighted mean of the members."""

    ids: IntArray  # (c,) >= 0, increasing
    positions: Array  # (c, 3)
    covs: Array  # (c, 3, 3)
    n_flowers: IntArray  # (c,)
    descriptors: Array  # (c, 2) inertia (m^2), mean distance (m)
    descriptor_covs: Array  # (c, 2, 2)
    first_seen: Array  # (c,) s
    last_seen: Array  # (c,) s
    n_observations: IntArray  # (c,)
    states: tuple[State, ...]  # (c,)

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Where each cluster's centroid was at each frame that saw it."""

    frame: IntArray  # (d,)
    cluster_ids: IntArray  # (d,)
    positions: Array  # (d, 3) world
    covs: Array  # (d, 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Hand-eye transform, its covariance of the tangent applied on the right, and what could not be observed."""

    T_flange_camera: Array  # (4, 4)
    cov: Array  # (6, 6)
    unobserved: tuple[str, ...] = ()  # directions in words; they stay at the prior


@dataclass(frozen=True, slots=True, eq=False)
class Diagnostics:
    """What the report shows beside the result."""

    nis: Array  # (m,) chi-square of each accepted observation after smoothing (3 degrees of freedom), NaN else
    reasons: IntArray  # (m,) RejectReason
    estimated_noise: dict[str, float] = field(default_factory=dict)  # same keys as StatedNoise, and what else is known


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """All that a result folder holds."""

    session: Session
    T_world_camera: Array  # (n, 4, 4)
    flower_ids: IntArray  # (m,) -1 = clutter
    cluster_ids: IntArray  # (m,) -1 exactly where flower_ids is
    flowers: Flowers
    clusters: Clusters
    drift: Drift
    calibration: Calibration | None
    diagnostics: Diagnostics
    command: str = "smooth"
    config: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    timings_s: dict[str, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    merged: tuple[tuple[int, int], ...] = ()
    status: Literal["ok", "poor"] = "ok"


@dataclass(frozen=True, slots=True, eq=False)
class Constellation:
    """Clusters and flowers at rest as one session brings them to a map, in the session's own world."""

    session: str
    start: float  # s, first frame; NaN where unknown
    end: float  # s, last frame
    flower_ids: IntArray  # (f,) the session's own
    flower_cluster_ids: IntArray  # (f,)
    flowers: Array  # (f, 3) world
    flower_covs: Array  # (f, 3, 3)
    cluster_ids: IntArray  # (c,) increasing
    descriptors: Array  # (c, 2) inertia (m^2), mean distance (m)
    descriptor_covs: Array  # (c, 2, 2)
    plant: str | None = None  # as the session names it
    viewpoint: Array | None = None  # (3,) mean camera position, world

    @property
    def clusters(self) -> Array:
        """Centroids (c, 3): the unweighted mean of each cluster's flowers."""
        row = np.searchsorted(self.cluster_ids, self.flower_cluster_ids)
        total = np.zeros((len(self.cluster_ids), 3))
        np.add.at(total, row, self.flowers)
        return total / np.maximum(np.bincount(row, minlength=len(total)), 1)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Flowers of a plant as its sessions saw them, in the order of the sessions."""

    flower_ids: IntArray  # (n,) persistent ids
    sessions: IntArray  # (n,) from 0, in the order in which the plant's sessions came
    session_times: Array  # (s,) s, NaN where unknown


@dataclass(frozen=True, slots=True, eq=False)
class PlantMap:
    """One plant of a map in the plant's own frame, with persistent ids.

    Each cluster and flower is where it was at its cluster's ``cluster_time``; ``cluster_slam.constellation.growth.at``
    moves a whole plant to another time, with covariances that have grown. Rates are per second. ``presence`` is the
    probability that it is still there. Clusters that have lost all flowers keep their row.
    """

    name: str
    cluster_ids: IntArray  # (c,) increasing
    clusters: Array  # (c, 3) map, at cluster_time
    cluster_covs: Array  # (c, 3, 3) of the displacement that all flowers of the cluster share
    cluster_time: Array  # (c,) s, what position and covariance are of; NaN where unknown
    velocities: Array  # (c, 3) m/s, learned drift
    velocity_covs: Array  # (c, 3, 3)
    position_velocity_covs: Array  # (c, 3, 3)
    growth_rates: Array  # (c,) 1/s, relative growth of all lengths within the cluster
    growth_vars: Array  # (c,)
    n_flowers: IntArray  # (c,)
    descriptors: Array  # (c, 2) inertia (m^2), mean distance (m)
    descriptor_covs: Array  # (c, 2, 2)
    cluster_first_seen: Array  # (c,) s
    cluster_last_seen: Array  # (c,) s
    cluster_last_looked_at: Array  # (c,) s
    cluster_presence: Array  # (c,)
    flower_ids: IntArray  # (f,) increasing
    flower_cluster_ids: IntArray  # (f,)
    flowers: Array  # (f, 3) map, at the cluster_time of its cluster
    flower_covs: Array  # (f, 3, 3) of its place within the cluster: independent of cluster_covs
    flower_first_seen: Array  # (f,) s
    flower_last_seen: Array  # (f,) s
    flower_last_looked_at: Array  # (f,) s
    flower_presence: Array  # (f,)
    viewpoint: Array | None = None  # (3,) mean camera position over the sessions, map
    last_session: float = float("nan")  # s, end of the latest session
    drift_rate: float = 0.003  # m/day, RMS norm of the drift of a cluster, as learned so far
    walk_rate: float = 0.0007  # m/sqrt(day), one sigma an axis of a cluster's random walk, as learned so far
    sightings: Sightings | None = None  # None: of each flower the first and the last one are known

    @property
    def flower_rows(self) -> IntArray:
        """Row of each flower's cluster (f,)."""
        return np.searchsorted(self.cluster_ids, self.flower_cluster_ids).astype(np.int64)

    @property
    def flower_total_covs(self) -> Array:
        """Covariances (f, 3, 3) of the flowers' positions: the cluster's and their own."""
        total: Array = self.cluster_covs[self.flower_rows] + self.flower_covs
        return total


LostReason = Literal["", "ambiguous", "too_few", "no_match"]


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypotheses:
    """Poses that explain a frame, best first within each frame."""

    frame: IntArray  # (h,)
    rank: IntArray  # (h,) from 1
    probability: Array  # (h,)
    T_map_camera: Array  # (h, 4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class SessionLocalisation:
    """Where the frames of a session are in a map. A frame is located exactly where its reason is empty."""

    session: Session
    reasons: tuple[LostReason, ...]  # (n,) why a frame is lost
    plants: tuple[str, ...]  # (n,) of the best hypothesis, "" where there is none
    n_inliers: IntArray  # (n,) points that are flowers of the map
    probability: Array  # (n,) of the best hypothesis
    T_map_camera: Array  # (n, 4, 4) NaN where lost
    covs: Array  # (n, 6, 6) tangent on the right, NaN where lost
    flower_ids: IntArray  # (m,) of the map, -1 = none
    cluster_ids: IntArray  # (m,) of the map, -1 = none
    hypotheses: PoseHypotheses
    config: dict[str, Any] = field(default_factory=dict)
    seed: int = 0
    timings_s: dict[str, float] = field(default_factory=dict)
    estimated_noise: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    status: Literal["ok", "poor"] = "ok"

    @property
    def is_located(self) -> BoolArray:
        """Which frames are located (n,)."""
        return np.array([reason == "" for reason in self.reasons], dtype=bool)
