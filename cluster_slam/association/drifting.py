"""Association where poses drift: maps grow stretch by stretch, are joined, and decisions are undone.

Dead reckoning cannot be trusted for longer than a few seconds, so points are compared with landmarks from an
*estimated* pose. First the instruments' own errors are taken out (``calibration``). What lies between two gaps is then
mapped for itself (``drift_growth``), and these maps are joined (``drift_joining``). In the end every stretch is
associated once more, with the map that the others make (``drift_redo``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.calibration import Calibration, calibrate, delayed
from cluster_slam.association.drift_joining import assemble
from cluster_slam.association.drift_labels import State, View
from cluster_slam.association.drift_redo import redo
from cluster_slam.association.drift_session import DriftSession
from cluster_slam.association.drift_smoother import DriftSmoother, Steps, steps_of
from cluster_slam.association.frames import Frames
from cluster_slam.association.seen_frames import filled, only_seen, seen_frames, step_of_each, summed_steps
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.records import IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """Camera poses (n, 4, 4), landmark of each point (m,) or -1, places (l, 3), covariances (n - 1, 6, 6) of the steps.

    The covariances are the given ones as the session has shown them: larger where odometry slipped. ``cost`` is twice
    the negative log-likelihood with the landmarks' price. All holds for frames and poses as ``instruments`` correct
    them.
    """

    T: Array
    label: IntArray
    places: Array
    cov_step: Array
    cost: float
    instruments: Calibration


def drifts_far(frames: Frames, given: Array, cov_step: Array) -> bool:
    """Whether poses (n, 4, 4) drift too far for an association by the given poses: by more than the points' noise."""
    if len(seen_frames(frames)) < 3:
        return False
    range_sq = float(np.median((frames.points**2).sum(axis=1)))
    total = cov_step.sum(axis=0)
    drift_sq = np.trace(total[3:, 3:]) + np.trace(total[:3, :3]) * range_sq
    noise_sq = float(np.median(np.trace(frames.covs, axis1=1, axis2=2)))
    return bool(drift_sq > 9.0 * noise_sq)


def frames_tell_poses(frames: Frames) -> bool:
    """Whether frames usually hold more points than their pose has unknowns, and so correct its drift."""
    return len(frames) >= 6 * len(seen_frames(frames))


def trace_drifting(
    frames: Frames, given: Array, cov_step: Array, config: ParticleConfig, *, rng: np.random.Generator
) -> Traced:
    """Poses and association of a session whose poses drift.

    Parameters
    ----------
    frames : Frames
    given : (n, 4, 4) camera poses by odometry; the first defines the world.
    cov_step : (n - 1, 6, 6) of each step, tangent at its end.
    config : options.
    rng : for the particles.
    """
    kept = seen_frames(frames)
    shown, cov_shown = only_seen(frames, kept), summed_steps(given, cov_step, kept)
    calibration = calibrate(shown, given[kept], config)
    late = delayed(given, frames.stamps, calibration.lag_s)
    steps = steps_of(late[kept], cov_shown, shown.stamps, config)
    best = _searched(shown, late[kept], steps, calibration, config, rng)
    weights = DriftSmoother(calibration.correct(shown), steps, config.point_dof).step_weights(best.T)
    best = _anchored(replace(best, T=filled(best.T, kept, late)), given[0])
    scaled = cov_step * (config.odometry_scale**2 / step_of_each(weights, kept, len(cov_step)))[:, None, None]
    return Traced(best.T, best.label, best.places, scaled, best.cost, calibration)


def _searched(
    frames: Frames,
    late: Array,
    steps: Steps,
    calibration: Calibration,
    config: ParticleConfig,
    rng: np.random.Generator,
) -> State:
    """The likeliest state found, all frames having points."""
    # Sharp points close by lead a search astray: the way is found with the usual noise at all ranges.
    seen = calibration.correct(frames)
    view = View.of(seen.points)
    rough = DriftSession(calibration.without_growth().correct(frames), late, steps, config, rng, view)
    wholes = [_priced(rough, state) for state in assemble(rough)]
    fine = DriftSession(seen, late, steps, config, rng, view)
    start = min((_priced(fine, state) for state in wholes), key=lambda state: state.cost)
    return redo(fine, start, config.landmark_cost)


def _priced(session: DriftSession, state: State) -> State:
    """The same with the final price of landmarks, which merges more of them."""
    price = session.config.landmark_cost
    return session.labels.merge(session.labels.settle(state.T, state.label, state.places, price), price, 40)


def _anchored(state: State, first: Array) -> State:
    """The same with the first pose (4, 4) where it defines the world."""
    home = first @ inverse(state.T[0])
    return State(home @ state.T, state.label, transform(home, state.places), state.cost)
