"""Localisation of a session in a map, to be read like the method section of a paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from time import perf_counter

import numpy as np

from cluster_slam.association.depth_noise import powers_of_depth
from cluster_slam.association.frames import sort_by_frame
from cluster_slam.config import LocaliseConfig
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log
from cluster_slam.localisation import Landmarks, Localisation, Localiser
from cluster_slam.localisation.following import Follower, Place
from cluster_slam.localisation.instruments import put_right
from cluster_slam.localisation.learning import Seen, learn_scale
from cluster_slam.localisation.merging import merged_points
from cluster_slam.localisation.motion import Motion, motion_of
from cluster_slam.localisation.planar import Flat, flat_world
from cluster_slam.localisation.scene import ErrorScale, Look, make_look
from cluster_slam.localisation.vehicle import FlatFollower
from cluster_slam.records import CLUTTER, IntArray, PlantMap, PoseHypotheses, Session, SessionLocalisation
from tracking.gating import chi2_threshold

Progress = Callable[[str, float], None]
_N_LEARNING = 40  # frames from which the errors' scale is learnt, spread over the session
_N_TOGETHER = 10  # frames that tell which plant of many is in view
_N_POSE_LEARNING = 150  # frames in a row from which the given poses' errors are learnt


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
    frames = _Frames(session, localiser)
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
    elif window is not None:
        places = [_from_window(frames, motion, i, window) for i in _told(session.n_frames, say)]
    else:
        frames.learn_poses(motion)
        places = _followed(frames, motion, _told(session.n_frames, say))
        if smooth:
            backwards = _followed(frames, motion, range(session.n_frames - 1, -1, -1))[::-1]
            fuse = _fused if motion.is_odometry else _surer
            places = [fuse(a, b) for a, b in zip(places, backwards, strict=True)]
    timings = {"map": ready - begin, "localising": perf_counter() - ready}
    return _session_localisation(session, frames, places, config, timings)


def _told(n: int, say: Progress) -> Iterator[int]:
    """Frame numbers, each announced."""
    for i in range(n):
        say("localising", 0.1 + 0.9 * i / n)
        yield i


class _Frames:
    """The frames of a session, ready to be looked at; what one frame alone says is found out once."""

    def __init__(self, session: Session, localiser: Localiser) -> None:
        self.session, self.localiser = session, localiser
        self.rows = _rows_of_frames(session)
        ordered = sort_by_frame(session.observations, session.stamps)
        self.scale = replace(localiser.errors, depth_powers=powers_of_depth(ordered))
        self.motion: Motion | None = None  # where frames may be taken together
        self._found: dict[int, Localisation] = {}
        self._plant: int | None = None  # that was seen last

    def look(self, i: int, scale: ErrorScale | None = None) -> Look:
        o, rows = self.session.observations, self.rows[i]
        return make_look(o.points[rows], o.covs[rows], scale or self.scale)

    def search(self, i: int) -> Localisation:
        """The frame by itself, with no prior."""
        if i not in self._found:
            o, rows = self.session.observations, self.rows[i]
            for among in self._plants(i):
                found = self.localiser.locate_points(o.points[rows], o.covs[rows], scale=self.scale, among=among)
                self._found[i] = found
                if found.is_located:
                    self._plant = found.hypotheses[0].plant
                    break
        return self._found[i]

    def _plants(self, i: int) -> Iterator[Sequence[int] | None]:
        """Plants among which a frame is looked for: all of a few; of many the last one, then those that it may show."""
        if self.localiser.atlas is None:
            yield None
            return
        if self._plant is not None:
            yield [self._plant]
        yield self.localiser.likely_plants(self._together(i))

    def _together(self, i: int) -> Array:
        """Points (n, 3) in the camera of frame i: its own, with those of the frames before where motion is known."""
        if self.motion is None:
            return self.look(i).points
        motion, first = self.motion, max(0, i - _N_TOGETHER + 1)
        steps = np.stack([motion.camera_step(i, k, motion.X0) for k in range(first, i + 1)])
        return merged_points([self.look(k) for k in range(first, i + 1)], steps, self.scale.sway_m)

    def learn(self) -> None:
        """How large the errors are, from frames that are located for sure; twice, as gates follow from it."""
        n = self.session.n_frames
        chosen = np.unique(np.linspace(0, n - 1, min(n, _N_LEARNING)).round().astype(np.int64)).tolist()
        for _ in range(2):
            found = [(i, self.search(i)) for i in chosen]
            sure = [(i, f) for i, f in found if f.is_located]
            self._found = {}
            if not sure:
                return
            seen = [
                Seen(self.look(i), self.localiser.plants[f.hypotheses[0].plant], f.hypotheses[0].fit) for i, f in sure
            ]
            before = self.scale
            self.scale = learn_scale(seen, self.scale)
            chosen = [i for i, _ in sure]
            if abs(np.log(self.scale.flower_variance / before.flower_variance)) < 0.3:
                return

    def learn_poses(self, motion: Motion) -> None:
        """How large the errors of the given poses are, from a track through the first frames."""
        n = min(self.session.n_frames, _N_POSE_LEARNING)
        for _ in range(2):
            follower = Follower(self.localiser, motion, self.scale, self.search, self.localiser.config.sway_time_s)
            steps = [
                place.step for i in range(n) if (place := follower.step(i, self.look(i))).reason == "" and place.step
            ]
            observed = sum(s.pose_error_sq for s in steps)
            expected = sum(s.pose_error_sq_expected for s in steps)
            ratio = float(np.clip((observed + 30.0) / (expected + 30.0), 0.1, 10.0))
            self.scale = replace(self.scale, pose_variance=self.scale.pose_variance * ratio)
            if abs(np.log(ratio)) < 0.2:
                return

    def alone(self, i: int) -> Place:
        """Where one frame is, from itself alone."""
        found = self.search(i)
        best = found.hypotheses[0].fit if found.hypotheses else None
        return Place(
            found.reason,
            found.plant,
            found.probability,
            None if best is None else best.T_map_camera,
            None if best is None else best.cov,
            found.flower_ids,
            found.cluster_ids,
            tuple((h.probability, h.fit.T_map_camera) for h in found.hypotheses),
        )


def _followed(frames: _Frames, motion: Motion, order: Iterable[int]) -> list[Place]:
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


def _on_floor(frames: _Frames, flat: Flat, marks: Landmarks, seed: int, say: Progress) -> list[Place]:
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


def _from_window(frames: _Frames, motion: Motion, i: int, window: int) -> Place:
    """Where a frame is, from the frames of a window that ends with it."""
    return _followed(frames, motion, range(max(0, i - window + 1), i + 1))[-1]


def _point_sigma(session: Session) -> float:
    covs = session.observations.covs
    return float(np.sqrt(np.trace(covs, axis1=1, axis2=2).mean() / 3.0)) if len(covs) else 0.005


def _asked(session: Session, plants: Sequence[PlantMap | Landmarks]) -> Sequence[PlantMap | Landmarks]:
    """The plant that the session names, where the map has it; else all."""
    named = [p for p in plants if (p.plant if isinstance(p, Landmarks) else p.name) == session.plant]
    return named or plants


def _rows_of_frames(session: Session) -> list[IntArray]:
    """Rows of the observations of each frame, in their order."""
    frame = session.observations.frame
    order = np.argsort(frame, kind="stable")
    ends = np.searchsorted(frame[order], np.arange(session.n_frames + 1))
    return [order[a:b] for a, b in pairwise(ends.tolist())]


def _session_localisation(
    session: Session, frames: _Frames, places: list[Place], config: LocaliseConfig, timings: dict[str, float]
) -> SessionLocalisation:
    n, rows = session.n_frames, frames.rows
    T, covs = np.full((n, 4, 4), np.nan), np.full((n, 6, 6), np.nan)
    flowers, clusters = (np.full(len(session.observations), CLUTTER) for _ in range(2))
    marks = {p.plant: p for p in frames.localiser.plants}
    for i, place in enumerate(places):
        if place.reason == "" and place.T_map_camera is not None and place.cov is not None:
            T[i], covs[i] = place.T_map_camera, marks[place.plant].in_first_frame(place.cov, place.T_map_camera)
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
