"""From frame to frame: kidnapped first, several candidate poses until motion has decided, then tracking.

Candidates are tracks that begin at different hypotheses of the frames so far. Each gathers evidence with every frame;
frames that show nothing new count little, since also an unknown plant would look the same twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.localisation.evidence import count_evidence, null_density, null_log_likelihood
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.localiser import Localisation, Localiser
from cluster_slam.localisation.motion import Motion
from cluster_slam.localisation.scene import ErrorScale, Look
from cluster_slam.localisation.tracking import Step, Track, start
from cluster_slam.records import CLUTTER, IntArray, LostReason

_N_CANDIDATES = 8
_WORSE_BY = 25.0  # log of the evidence: a candidate so far behind the best is given up
_LEAST_EVIDENCE = -12.0  # a hypothesis below is not worth a candidate
_LEAST_NEWS = 0.1  # what a frame counts that shows only flowers already seen
_LOST_SHARE = 0.25  # of the points matched over the last frames: below, the track is lost
_LOST_POINTS = 12  # points that must have been seen to say so
_SEARCHES = 40  # frames a lost track looks at with all means before it looks at every fifth only


@dataclass(slots=True, eq=False)
class Candidate:
    """A track with the evidence that it has."""

    plant: int
    track: Track
    evidence: float
    last: Step
    seen: set[int]  # flowers


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a frame is, or why that is not known."""

    reason: LostReason
    plant: str
    probability: float
    T_map_camera: Array | None  # of the best candidate
    cov: Array | None
    flower_ids: IntArray  # (n,)
    cluster_ids: IntArray  # (n,)
    hypotheses: tuple[tuple[float, Array], ...]  # probability, T_map_camera; best first
    step: Step | None = None

    @property
    def n_inliers(self) -> int:
        return int((self.flower_ids != CLUTTER).sum())


Search = Callable[[int], Localisation]


class Follower:
    """Frames in their order, one by one."""

    def __init__(
        self, localiser: Localiser, motion: Motion, scale: ErrorScale, search: Search, sway_time_s: float
    ) -> None:
        """``search`` localises one frame by its index with no prior."""
        self.localiser, self.motion, self.scale, self.search = localiser, motion, scale, search
        self.sway_time_s = sway_time_s
        self.candidates: list[Candidate] = []
        self.is_sure = False
        self._recent: list[tuple[int, int]] = []  # points, matched
        self._n_searched = 0
        self._spacing: dict[int, float] = {}

    def step(self, frame: int, look: Look) -> Place:
        """The next frame."""
        for c in self.candidates:
            self._advance(c, frame, look)
        if self.is_sure and self._has_lost(look):
            self.candidates, self.is_sure = [], False
        found: Localisation | None = None
        if not self.is_sure:
            self._n_searched += 1
            if self._n_searched <= _SEARCHES or self._n_searched % 5 == 0:
                found = self.search(frame)
                self._take_up(frame, look, found)
            self._decide()
        return self._place(frame, look, found)

    def _advance(self, c: Candidate, frame: int, look: Look) -> None:
        marks = self.localiser.plants[c.plant]
        c.last = c.track.step(frame, look, null_density(marks, look) if len(look) else 1.0)
        if self.is_sure:
            self._recent = [*self._recent[-9:], (len(look), len(c.last.rows))]
        elif len(look):
            c.evidence += self._gain(c, marks, look)
        c.seen.update(c.last.flowers.tolist())

    def _gain(self, c: Candidate, marks: Landmarks, look: Look) -> float:
        step = c.last
        new = sum(f not in c.seen for f in step.flowers.tolist())
        news = max(new / max(len(step.flowers), 1), _LEAST_NEWS)
        points = 0.0
        if len(step.rows):
            points = step.log_likelihood - null_log_likelihood(step.rows, step.flowers, look, marks)
        rest = count_evidence(step.T_map_camera, step.rows, step.flowers, look, marks, self.scale)
        return float(news * (points + rest))

    def _take_up(self, frame: int, look: Look, found: Localisation) -> None:
        """Begin a candidate at each hypothesis of the frame that is not one already."""
        for h in found.hypotheses[:_N_CANDIDATES]:
            if h.log_evidence < _LEAST_EVIDENCE or not np.isfinite(h.fit.cov).all():
                continue
            if any(
                c.plant == h.plant and _agree(c.track.T, h.fit.T_map_camera, h.fit.information, c.track.pose_cov)
                for c in self.candidates
            ):
                continue
            marks = self.localiser.plants[h.plant]
            track = start(marks, self.motion, frame, h.fit.T_map_camera, self.scale, self.sway_time_s)
            log_likelihood, nis = track.update(look, h.fit.rows, h.fit.flowers, 4)
            first = Step(
                frame,
                track.T,
                track.pose_cov,
                h.fit.rows,
                h.fit.flowers,
                h.fit.T_map_camera,
                np.diag(np.full(6, 1e6)),
                log_likelihood,
                nis,
                0.0,
                0.0,
            )
            self.candidates.append(Candidate(h.plant, track, h.log_evidence, first, set(h.fit.flowers.tolist())))
        self.candidates.sort(key=lambda c: -c.evidence)
        best = self.candidates[0].evidence if self.candidates else 0.0
        self.candidates = [c for c in self.candidates if c.evidence > best - _WORSE_BY][:_N_CANDIDATES]

    def probabilities(self) -> Array:
        """Of the candidates (c,), beside the chance that none is right."""
        config = self.localiser.config
        prior = np.log(config.map_prior / len(self.localiser.plants))
        logs = np.array([c.evidence + prior for c in self.candidates] + [np.log1p(-config.map_prior)])
        p = np.exp(logs - logs.max())
        out: Array = (p / p.sum())[:-1]
        return out

    def _decide(self) -> None:
        if not self.candidates:
            return
        self.candidates.sort(key=lambda c: -c.evidence)
        best, config = self.candidates[0], self.localiser.config
        marks = self.localiser.plants[best.plant]
        n_clusters = len(np.unique(marks.cluster[sorted(best.seen)]))
        enough = n_clusters >= config.min_clusters and len(best.seen) >= config.min_flowers
        if enough and self.probabilities()[0] >= config.sure_probability:
            self._probability = float(self.probabilities()[0])
            self.is_sure, self.candidates, self._n_searched = True, [best], 0
            self._recent = []

    _probability: float = 0.0

    def _has_lost(self, look: Look) -> bool:
        points, matched = (sum(x) for x in zip(*self._recent, strict=True)) if self._recent else (0, 0)
        if points >= _LOST_POINTS and matched < _LOST_SHARE * points:
            return True
        return self._blur(self.candidates[0], look) > 2.0

    def _blur(self, c: Candidate, look: Look) -> float:
        """How far a flower may be from where it is expected, one sigma, over half the distance between flowers."""
        reach = float(np.linalg.norm(look.points, axis=1).mean()) if len(look) else 0.5
        P = c.track.pose_cov
        var = (np.trace(P[3:, 3:]) + reach**2 * np.trace(P[:3, :3])) / 3.0
        if c.plant not in self._spacing:
            self._spacing[c.plant] = _spacing(self.localiser.plants[c.plant])
        return float(np.sqrt(max(var, 0.0)) / (0.5 * self._spacing[c.plant]))

    def _place(self, frame: int, look: Look, found: Localisation | None) -> Place:
        flowers, clusters = np.full(len(look), CLUTTER), np.full(len(look), CLUTTER)
        if not self.candidates:
            reason: LostReason = found.reason if found is not None and found.reason else "no_match"
            return Place(reason, "", 0.0, None, None, flowers, clusters, ())
        best = self.candidates[0]
        marks = self.localiser.plants[best.plant]
        flowers[best.last.rows] = marks.flower_ids[best.last.flowers]
        clusters[best.last.rows] = marks.cluster_ids[best.last.flowers]
        if self.is_sure:
            reason = "" if self._blur(best, look) < 1.0 else "too_few"
            only = ((self._probability, best.track.T),)
            return Place(
                reason,
                marks.plant,
                self._probability,
                best.track.T,
                best.track.pose_cov,
                flowers,
                clusters,
                only,
                best.last,
            )
        p = self.probabilities()
        several = tuple((float(q), c.track.T) for q, c in zip(p, self.candidates, strict=True))
        reason = self._why(found, float(p.sum()), best)
        return Place(
            reason,
            marks.plant,
            float(p[0]),
            best.track.T,
            best.track.pose_cov,
            flowers,
            clusters,
            several,
            best.last,
        )

    def _why(self, found: Localisation | None, inside: float, best: Candidate) -> LostReason:
        if inside < 0.5:
            return "no_match"
        marks, config = self.localiser.plants[best.plant], self.localiser.config
        n_clusters = len(np.unique(marks.cluster[sorted(best.seen)]))
        if n_clusters < config.min_clusters or len(best.seen) < config.min_flowers:
            return "too_few"
        return "ambiguous"


def _agree(T: Array, other: Array, information: Array, cov: Array) -> bool:
    """Whether two estimates may well be of one pose."""
    xi = se3_log(inverse(T) @ other)
    total = cov + np.linalg.solve(information, np.eye(6))
    return bool(xi @ np.linalg.solve(total, xi) < 25.0)


def _spacing(marks: Landmarks) -> float:
    """Median distance (m) from a flower to the next."""
    from scipy.spatial import cKDTree

    if len(marks) < 2:
        return np.inf
    apart = np.asarray(cKDTree(marks.positions).query(marks.positions, k=2)[0])
    return float(np.median(apart[:, 1]))
