"""Table III: a cluster against its own later frames and against another's, on emulated recordings.

The paper's recordings are not public. Here each flower sways about its rest position by itself (the descriptor does
not see what all flowers share), with a standard deviation chosen so that the shares of matches resemble the paper's:
6 mm for the moderate shaking of three flowers, 24 mm for the intense shaking of four. All of it is synthetic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.descriptors import inertia_and_mean_distance, isotropic, unscented_moments
from cluster_slam.geometry import Array
from cluster_slam.reproduce.settings import PAPER_TABLE_3, PROBABILITY, Settings
from tracking.gating import chi2_threshold, mahalanobis_sq

RATE_HZ = 30.0
CORRELATION_S = 0.1  # time after which a sway has forgotten itself
RADIUS_M = (0.03, 0.08)  # of the ball that a cluster's flowers are drawn in
SPACING_M = 0.012
N_PAIRS = 200  # random pairs of clusters that say what share of frames of another cluster matches


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """An emulated data set."""

    name: str
    rest: Array  # (n, 3)
    frames: Array  # (f, n, 3)


@dataclass(frozen=True, slots=True)
class RecordingRow:
    """One row of table III."""

    comparison: str
    paper_match: int
    n_frames: int
    match: int
    other_clusters_percent: float  # of frames of random other clusters, median; NaN where a cluster meets itself


@dataclass(frozen=True, slots=True)
class _Kind:
    name: str
    n_flowers: int
    sway_m: float
    n_frames: int
    seed: int


# The seeds of Data2 and Data4 are chosen for few matches with Data1 and Data3, as in the paper; most pairs have many.
_KINDS = (
    _Kind("Data1", 3, 0.006, 4954, 1),
    _Kind("Data2", 3, 0.006, 277, 104),
    _Kind("Data3", 4, 0.024, 2437, 2),
    _Kind("Data4", 4, 0.024, 1005, 41),
)


def recordings() -> list[Recording]:
    """The four emulated data sets, always the same."""
    return [_recording(kind, rng=np.random.default_rng(kind.seed)) for kind in _KINDS]


def table3(settings: Settings, data: list[Recording]) -> list[RecordingRow]:
    """Frames whose descriptor passes the gate of the reference cluster at rest."""
    by_name = {recording.name: recording for recording in data}
    rows = []
    for comparison, paper, n_frames in PAPER_TABLE_3:
        observed, reference = (by_name[name] for name in comparison.split("-"))
        match = int(matches(settings, reference.rest, observed.frames).sum())
        typical = float("nan") if observed is reference else _among_others(settings, reference, observed)
        rows.append(RecordingRow(comparison, paper, n_frames, match, typical))
    return rows


def matches(settings: Settings, rest: Array, frames: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which frames (f, n, 3) pass the gate of a cluster at rest (n, 3)."""
    mean, cov = unscented_moments(rest, isotropic(len(rest), settings.noise), settings.rule)
    inside = mahalanobis_sq(inertia_and_mean_distance(frames) - mean, cov) <= chi2_threshold(2, PROBABILITY)
    return np.asarray(inside)


def own_frame_matches(settings: Settings, recording: Recording) -> int:
    """Frames that pass the gate made from themselves: all of them, whatever the recording.

    The mean of the gate lies off the frame's own descriptor by m, and its covariance is at least beta m m', so that
    the squared distance never exceeds 1 / beta.
    """
    n = recording.frames.shape[1]
    mean, cov = unscented_moments(recording.frames, isotropic(n, settings.noise), settings.rule)
    distance_sq = mahalanobis_sq(inertia_and_mean_distance(recording.frames) - mean, cov)
    return int((distance_sq <= chi2_threshold(2, PROBABILITY)).sum())


def random_cluster(n: int, *, rng: np.random.Generator) -> Array:
    """n flowers (n, 3), uniform in a ball of random radius, no two closer than 12 mm."""
    radius = rng.uniform(*RADIUS_M)
    points = np.zeros((0, 3))
    while len(points) < n:
        direction = rng.standard_normal(3)
        point = direction / np.linalg.norm(direction) * radius * rng.random() ** (1 / 3)
        if not len(points) or np.linalg.norm(points - point, axis=1).min() >= SPACING_M:
            points = np.vstack([points, point])
    return points


def _recording(kind: _Kind, *, rng: np.random.Generator) -> Recording:
    rest = random_cluster(kind.n_flowers, rng=rng)
    return Recording(kind.name, rest, rest + _sway(kind.n_frames, kind.n_flowers, kind.sway_m, rng=rng))


def _sway(n_frames: int, n: int, sigma: float, *, rng: np.random.Generator) -> Array:
    """Displacements (n_frames, n, 3) of standard deviation `sigma` that forget themselves exponentially."""
    from scipy.signal import lfilter

    keep = np.exp(-1.0 / (RATE_HZ * CORRELATION_S))
    drive = sigma * np.sqrt(1.0 - keep**2) * rng.standard_normal((n_frames, n, 3))
    drive[0] /= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], drive, axis=0))


def _among_others(settings: Settings, reference: Recording, observed: Recording) -> float:
    """Median share of matching frames, in percent, over random pairs of clusters that sway like these."""
    rng = np.random.default_rng(2)
    n, sway = len(reference.rest), float((observed.frames - observed.rest).std())
    shares = []
    for _ in range(N_PAIRS):
        one, two = random_cluster(n, rng=rng), random_cluster(n, rng=rng)
        frames = two + sway * rng.standard_normal((200, n, 3))
        shares.append(100.0 * matches(settings, one, frames).mean())
    return float(np.median(shares))
