"""The end: everything into the tables of a result, in the order of the input, with reasons and warnings."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
from scipy.linalg import eigh
from scipy.spatial import cKDTree

from cluster_slam.association.displacement import (
    measured_displacements,
)
from cluster_slam.association.frames import Frames, chi2_and_log_det
from cluster_slam.config import SmoothConfig
from cluster_slam.geometry import Array, rotate_cov, transform
from cluster_slam.graph.batch import BatchSmoother, Estimate, Marginals
from cluster_slam.landmark_tables import RestMap, cluster_table, drift_table, flower_table
from cluster_slam.records import BoolArray, Calibration, Diagnostics, IntArray, RejectReason, Result, Session
from cluster_slam.smoothing.world import World, fewest_observations
from tracking.gating import chi2_threshold

_UNOBSERVED = 0.5  # share of the prior's variance that is left


def make_result(
    session: Session,
    frames: Frames,
    world: World,
    smoother: BatchSmoother,
    estimate: Estimate,
    marginals: Marginals,
    squared_innovation: Array,
    config: SmoothConfig,
    seed: int,
    merged: list[tuple[int, int]],
    timings: dict[str, float],
) -> Result:
    """Put everything into the tables of a result, in the order of the input's rows."""
    threshold = chi2_threshold(3, config.outlier_probability)
    outlier = (world.landmark >= 0) & (estimate.weight < 0.5)
    rest = RestMap(estimate.places, marginals.places, world.cluster, world.landmark)
    flowers = flower_table(rest, frames)
    n_clusters = int(world.cluster.max(initial=-1)) + 1
    warnings = shortcomings(session, frames, world)
    confirmed = np.zeros(n_clusters, dtype=bool)
    np.logical_or.at(confirmed, world.cluster, is_confirmed(world, outlier, fewest_observations(frames, config)))
    clusters = cluster_table(rest, frames, confirmed)
    pairs = smoother.pairs
    _, cov = measured_displacements(frames, estimate.T, world.landmark, estimate.places, pairs.of, len(pairs.frame))
    drift = drift_table(rest, frames, clusters, estimate.d, pairs.total_sigma**2, cov)
    flower_ids = np.full(len(frames), -1, dtype=np.int64)
    flower_ids[frames.order] = world.landmark
    cluster_ids = np.where(flower_ids >= 0, world.cluster[flower_ids], -1) if n_clusters else flower_ids
    reasons = np.full(len(frames), int(RejectReason.UNCONFIRMED))
    reasons[frames.order] = reject_reasons(frames, world, estimate, smoother, outlier)
    nis = np.full(len(frames), np.nan)
    nis[frames.order] = squared_innovation
    calibration = hand_eye_calibration(smoother, estimate, marginals)
    unobserved = () if calibration is None else tuple(f"hand-eye: {x}" for x in calibration.unobserved)
    return Result(
        session=session,
        T_world_camera=estimate.T,
        flower_ids=flower_ids,
        cluster_ids=cluster_ids,
        flowers=flowers,
        clusters=clusters,
        drift=drift,
        calibration=calibration,
        diagnostics=Diagnostics(
            nis=nis, reasons=reasons, estimated_noise=estimated_noise(session, frames, world, smoother)
        ),
        config=asdict(config),
        seed=seed,
        timings_s=timings,
        counts={
            "frames": frames.n_frames,
            "observations": len(frames),
            "flowers": len(flowers),
            "clusters": len(clusters),
            "clutter": int((world.landmark < 0).sum()),
            "outliers": int((np.nan_to_num(estimate.residual_chi2) > threshold).sum()),
            "merged": len(merged),  # before ids were given: none of them was ever used
        },
        warnings=(*session.warnings, *world.instruments.in_words(), *unobserved, *warnings),
        status="poor" if warnings else "ok",
    )


def reject_reasons(
    frames: Frames, world: World, estimate: Estimate, smoother: BatchSmoother, outlier: BoolArray
) -> IntArray:
    """Why each sorted observation (m,) has no flower: none stands there, another fits better, or it fits none."""
    reasons = np.where(outlier, int(RejectReason.OUTLIER), int(RejectReason.ACCEPTED))
    free = np.flatnonzero(world.landmark < 0)
    if len(free) == 0 or len(world.places) == 0:
        return np.where(world.landmark < 0, int(RejectReason.UNCONFIRMED), reasons)
    T = estimate.T[frames.frame[free]]
    w = transform(T, frames.points[free])
    nearest = np.asarray(cKDTree(world.places).query(w)[1])
    moved = np.zeros((frames.n_frames, int(world.cluster.max()) + 1, 3))
    moved[smoother.pairs.frame, smoother.pairs.cluster] = estimate.d
    offset = w - world.places[nearest] - moved[frames.frame[free], world.cluster[nearest]]
    chi2, _ = chi2_and_log_det(offset, rotate_cov(T[:, :3, :3], frames.covs[free]))
    taken = chi2 < chi2_threshold(3, 0.999)
    close = np.linalg.norm(offset, axis=1) < 3.0 * world.radius
    reasons[free] = np.where(
        taken,
        int(RejectReason.TAKEN),
        np.where(close, int(RejectReason.POSITION_GATE), int(RejectReason.UNCONFIRMED)),
    )
    return reasons


def hand_eye_calibration(smoother: BatchSmoother, estimate: Estimate, marginals: Marginals) -> Calibration | None:
    """The hand-eye transform with what the session could not tell of it: there it stays at its prior."""
    if estimate.X is None or marginals.hand_eye is None:
        return None
    # Generalised eigenvectors: directions in which the data leave more than half of the prior's variance.
    share, directions = eigh(marginals.hand_eye, smoother.poses.cov_hand_eye)
    sigma = np.sqrt(np.diag(smoother.poses.cov_hand_eye))
    unobserved = []
    for direction in directions.T[share > _UNOBSERVED]:
        axis = int(np.abs(direction / sigma).argmax())
        kind = "turn about" if axis < 3 else "shift along"
        unobserved.append(f"{kind} the camera's {'xyz'[axis % 3]} was not observed and stays as measured")
    return Calibration(estimate.X, marginals.hand_eye, tuple(dict.fromkeys(unobserved)))


def estimated_noise(session: Session, frames: Frames, world: World, smoother: BatchSmoother) -> dict[str, float]:
    """One-sigma errors as the session's own residuals have them; keys as in ``[noise]``, and the sway."""
    stated, noise = session.noise, world.noise
    found = {}
    if len(frames):
        rms = float(np.sqrt(np.trace(frames.covs, axis1=1, axis2=2).mean() / 3.0))
        found["flower"] = rms  # frames carry the variances that were found
    if session.pose_error == "absolute":
        found["pose_translation"] = stated.pose_translation * float(np.sqrt(noise.pose))
        found["pose_rotation"] = stated.pose_rotation * float(np.sqrt(noise.pose))
    found["wild_share"] = world.wild_share
    found["flower_factor"] = float(np.sqrt(noise.flower))
    if world.shape is not None:
        found["flower_factor"] = found["flower"] / stated.flower
        shape, factor = world.shape, float(np.sqrt(noise.flower))
        shape = replace(shape, depth=factor * shape.depth, lateral=factor * shape.lateral)
        found |= {f"flower_{name}": value for name, value in asdict(shape).items()}
    found["pose_factor"] = float(np.sqrt(noise.pose))
    if world.lasting is not None:
        found["flower_lasting_along"] = world.lasting.along_m
        found["flower_lasting_across"] = world.lasting.across_m
    if len(smoother.pairs.sigma):
        found["sway"] = float(np.sqrt((smoother.pairs.total_sigma**2).mean()))
    return found


def is_confirmed(world: World, outlier: BoolArray, minimum: int) -> BoolArray:
    """Which flowers (l,) stand: enough observations that agree, and more of those than of others."""
    n = len(world.places)
    total = np.bincount(world.landmark[world.landmark >= 0], minlength=n)
    disagree = np.bincount(world.landmark[outlier], minlength=n)
    stands: BoolArray = (total - disagree >= minimum) & (disagree <= 0.5 * total)
    return stands


def shortcomings(session: Session, frames: Frames, world: World) -> tuple[str, ...]:
    """Why the result is poor, in words; empty where it is not."""
    if len(frames) == 0:
        return ("no flowers in the session: there is nothing to find",)
    if len(world.places) == 0:
        return (f"none of the {len(frames)} observations was seen again: no flower could be confirmed",)
    share = float((world.landmark >= 0).mean())
    if share < 0.5:
        return (f"only {100 * share:.0f} % of the observations belong to a flower: the rest was taken for false ones",)
    return ()
