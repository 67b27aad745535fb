"""Localisation of a session in a map, to be read like the method section of a paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from time import perf_counter

import numpy as np

from cluster_slam.config import LocaliseConfig
from cluster_slam.geometry import inverse, se3_exp, se3_log
from cluster_slam.localisation import Landmarks, Localiser
from cluster_slam.localisation.following import Follower, Place
from cluster_slam.localisation.instruments import put_right
from cluster_slam.localisation.motion import Motion, motion_of
from cluster_slam.localisation.planar import Flat, flat_world
from cluster_slam.localisation.scene import ErrorScale
from cluster_slam.localisation.vehicle import FlatFollower
from cluster_slam.pipeline.localise_frames import Frames
from cluster_slam.records import CLUTTER, PlantMap, PoseHypotheses, Session, SessionLocalisation
from tracking.gating import chi2_threshold

Progress = Callable[[str, float], None]


def localise(
    session: Session,
    plants: Sequence[PlantMap | Landmarks],
    *,
    config: LocaliseConfig | None = None,
    independent: bool = False,
    window: int | None = None,
    smooth: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> SessionLocalisation:
    """Where the frames of a session are in a map.

    Parameters
    ----------
    session : as ``open_session`` reads it. Of its poses the motion from frame to frame is used, never where they are.
    plants : of the map; where the session names one of them, only that is looked at.
    config : the options, defaults where None.
    independent : every frame is kidnapped; poses are not used at all.
    window : every frame is located from so many frames that end with it, and forgets what was before. None: all.
    smooth : poses from all frames, later ones too.
    seed : of what is random (vehicles on a floor only).
    progress : called with the stage in words and a fraction 0..1.

    Raises
    ------
    InputError
        The map is empty.
    """
    config = config or LocaliseConfig()
    say = progress or (lambda _stage, _fraction: None)
    begin = perf_counter()
    say("reading the map", 0.0)
    localiser = Localiser(
        _asked(session, plants), config, time=float(session.stamps[0]), point_sigma_m=_point_sigma(session)
    )
    frames = Frames(session, localiser)
    ready = perf_counter()
    say("learning how large the errors are", 0.02)
    motion = motion_of(session)
    frames.motion = None if independent or window == 1 else motion
    frames.learn()
    flat = None if independent or window else _flat_world(session, motion, localiser)
    if flat is not None:
        places = _on_floor(frames, flat, localiser.plants[0], seed, say)
    elif independent or window == 1:
        places = [frames.alone(i) for i in _told(session.n_frames, say)]
    else:
        tracked = _tracked(frames, motion, window, smooth, say)
        places = [_in_first_frame(p, localiser) for p in tracked]
    timings = {"map": ready - begin, "localising": perf_counter() - ready}
    return _session_localisation(session, frames, places, config, timings)


def _tracked(frames: Frames, motion: Motion, window: int | None, smooth: bool, say: Progress) -> list[Place]:
    """Frames with what others say of them: those of a window, all before, or all."""
    n = frames.session.n_frames
    if window is not None:
        return [_followed(frames, motion, range(max(0, i - window + 1), i + 1))[-1] for i in _told(n, say)]
    frames.learn_poses(motion)
    places = _followed(frames, motion, _told(n, say))
    if not smooth:
        return places
    backwards = _followed(frames, motion, range(n - 1, -1, -1))[::-1]
    fuse = _fused if motion.is_odometry else _surer
    return [fuse(a, b) for a, b in zip(places, backwards, strict=True)]


def _in_first_frame(place: Place, localiser: Localiser) -> Place:
    """The place with what all of the map may have drifted in common."""
    if place.cov is None or place.T_map_camera is None:
        return place
    marks = next(p for p in localiser.plants if p.plant == place.plant)
    return replace(place, cov=marks.in_first_frame(place.cov, place.T_map_camera))


def _told(n: int, say: Progress) -> Iterator[int]:
    """Frame numbers, each announced."""
    for i in range(n):
        say("localising", 0.1 + 0.9 * i / n)
        yield i


def _followed(frames: Frames, motion: Motion, order: Iterable[int]) -> list[Place]:
    """Frames one after the other: kidnapped first, then tracked."""
    follower = Follower(frames.localiser, motion, frames.scale, frames.search, frames.localiser.config.sway_time_s)
    return [follower.step(i, frames.look(i)) for i in order]


def _surer(forwards: Place, backwards: Place) -> Place:
    """Of two directions of time the one that is surer.

    Where each given pose errs for itself the directions cannot be fused: both hold the frame's own given pose. What
    the other frames add is where the world is in the map, and the direction that has seen more frames knows that best.
    """
    if forwards.reason != "" or forwards.cov is None:
        return backwards
    if backwards.reason != "" or backwards.cov is None:
        return forwards
    return forwards if np.trace(forwards.cov) <= np.trace(backwards.cov) else backwards


def _fused(forwards: Place, backwards: Place) -> Place:
    """What both directions of time say of a frame (the two-filter smoother of Fraser and Potter, 1969).

    The second comes in as it was before it looked at the frame, so that no frame counts twice. Where they cannot both
    be right the frame stays as the first has it.
    """
    if forwards.reason != "":
        return backwards
    other, one = backwards.step, forwards
    if backwards.reason != "" or other is None or one.cov is None or one.T_map_camera is None:
        return forwards
    xi = se3_log(inverse(one.T_map_camera) @ other.predicted_T)
    total = one.cov + other.predicted_cov
    gain = np.linalg.solve(total, one.cov).T
    if xi @ np.linalg.solve(total, xi) > chi2_threshold(6, 0.9999):
        return forwards
    cov = one.cov - gain @ one.cov
    return replace(one, T_map_camera=one.T_map_camera @ se3_exp(gain @ xi), cov=0.5 * (cov + cov.T))


def _flat_world(session: Session, motion: Motion, localiser: Localiser) -> Flat | None:
    """The planes of a vehicle's motion and of its landmarks, where there is one plant and all is flat."""
    return flat_world(session, motion, localiser.plants[0]) if len(localiser.plants) == 1 else None


def _on_floor(frames: Frames, flat: Flat, marks: Landmarks, seed: int, say: Progress) -> list[Place]:
    """Frames of a vehicle on a floor, one after the other."""
    say("finding what the instruments err by", 0.05)
    right = put_right(frames.session)
    follower = FlatFollower(flat, marks, motion_of(right.session), np.random.default_rng(seed))
    o, out = right.session.observations, []
    for i in _told(frames.session.n_frames, say):
        rows = frames.rows[i]
        p = follower.step(i, o.points[rows], o.covs[rows], right.news[rows])
        one = (p.probability, p.T_map_camera)
        out.append(
            Place(p.reason, marks.plant, p.probability, p.T_map_camera, p.cov, p.flower_ids, p.cluster_ids, (one,))
        )
    return out


def _point_sigma(session: Session) -> float:
    covs = session.observations.covs
    return float(np.sqrt(np.trace(covs, axis1=1, axis2=2).mean() / 3.0)) if len(covs) else 0.005


def _asked(session: Session, plants: Sequence[PlantMap | Landmarks]) -> Sequence[PlantMap | Landmarks]:
    """The plant that the session names, where the map has it; else all."""
    named = [p for p in plants if (p.plant if isinstance(p, Landmarks) else p.name) == session.plant]
    return named or plants


def _session_localisation(
    session: Session, frames: Frames, places: list[Place], config: LocaliseConfig, timings: dict[str, float]
) -> SessionLocalisation:
    n, rows = session.n_frames, frames.rows
    T, covs = np.full((n, 4, 4), np.nan), np.full((n, 6, 6), np.nan)
    flowers, clusters = (np.full(len(session.observations), CLUTTER) for _ in range(2))
    for i, place in enumerate(places):
        if place.reason == "" and place.T_map_camera is not None and place.cov is not None:
            T[i], covs[i] = place.T_map_camera, place.cov
            flowers[rows[i]], clusters[rows[i]] = place.flower_ids, place.cluster_ids
    warnings = () if any(p.reason == "" for p in places) else ("no frame was located",)
    return SessionLocalisation(
        session=session,
        reasons=tuple(p.reason for p in places),
        plants=tuple(p.plant for p in places),
        n_inliers=np.array([p.n_inliers for p in places], dtype=np.int64),
        probability=np.array([p.probability for p in places]),
        T_map_camera=T,
        covs=covs,
        flower_ids=flowers,
        cluster_ids=clusters,
        hypotheses=_hypotheses(places),
        config=asdict(config),
        timings_s=timings,
        estimated_noise=_noise(session, frames.scale),
        warnings=(*session.warnings, *warnings),
        status="poor" if warnings else "ok",
    )


def _noise(session: Session, scale: ErrorScale) -> dict[str, float]:
    """The errors as learnt, by the names that sessions state them under."""
    stated = session.noise
    return {
        "flower": float(np.sqrt(scale.flower_variance)) * stated.flower,
        "pose_translation": float(np.sqrt(scale.pose_variance)) * stated.pose_translation,
        "pose_rotation": float(np.sqrt(scale.pose_variance)) * stated.pose_rotation,
        "sway": scale.sway_m,
        "detection": scale.detection,
        "unmapped": scale.unmapped,
    }


def _hypotheses(places: list[Place]) -> PoseHypotheses:
    """Those of the frames that have more than one."""
    several = [(i, p) for i, p in enumerate(places) if len(p.hypotheses) > 1]
    each = [(i, k + 1, *h) for i, p in several for k, h in enumerate(p.hypotheses)]
    return PoseHypotheses(
        frame=np.array([e[0] for e in each], dtype=np.int64),
        rank=np.array([e[1] for e in each], dtype=np.int64),
        probability=np.array([e[2] for e in each], dtype=float),
        T_map_camera=np.array([e[3] for e in each], dtype=float).reshape(-1, 4, 4),
    )
