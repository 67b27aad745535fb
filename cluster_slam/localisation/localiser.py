"""A camera kidnapped: where in the map is this frame seen from, and how sure is that?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.config import LocaliseConfig
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.localisation.atlas import Atlas
from cluster_slam.localisation.evidence import log_evidence, null_density
from cluster_slam.localisation.fit import Fit, refine
from cluster_slam.localisation.hypotheses import PlantIndex, distinct, rough_poses, sharpened
from cluster_slam.localisation.landmarks import Landmarks, landmarks_at
from cluster_slam.localisation.scene import ErrorScale, Look, make_look
from cluster_slam.records import CLUTTER, Frame, IntArray, LostReason, PlantMap


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One pose that explains the frame."""

    plant: int  # index of the plant in the localiser
    fit: Fit
    log_evidence: float
    probability: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """Where a frame is, or why that is not known."""

    reason: LostReason
    hypotheses: tuple[Hypothesis, ...]  # best first
    plant: str  # of the best hypothesis, "" where there is none
    flower_ids: IntArray  # (n,) of the map, -1 none; the best hypothesis'
    cluster_ids: IntArray  # (n,)
    pose_cov: Array | None = None  # (6, 6) of the best hypothesis, with what all of the map may have drifted

    @property
    def is_located(self) -> bool:
        return self.reason == ""

    @property
    def T_map_camera(self) -> Array:
        """The best pose (4, 4)."""
        return self.hypotheses[0].fit.T_map_camera

    @property
    def cov(self) -> Array:
        """Its covariance (6, 6), tangent on the right, in the frame of the map's first session."""
        return self.hypotheses[0].fit.cov if self.pose_cov is None else self.pose_cov

    @property
    def probability(self) -> float:
        return self.hypotheses[0].probability if self.hypotheses else 0.0


Plant = Landmarks | PlantMap
_MOST_TRIED = 8  # plants that are searched one after the other; of more, those that the index of triples names
_WORSE_BY = 25.0  # log of the likelihood, roughly: a guess so far behind the best has no share in the probability
_TURNED = 1.0 + 2.0 * float(np.cos(0.5))  # trace of a turn by half a radian: never the same pose
_NEAR_SCORE = 1.5  # groups by which a plant that is looked at may be behind the first
_MOST_THOROUGH = 2  # of many plants: those that are searched with all means where nothing is sure yet
_MOST_READY = 64  # plants that are kept made ready


class Localiser:
    """Finds frames in a frozen map, each for itself."""

    def __init__(
        self,
        plants: Plant | Sequence[Plant],
        config: LocaliseConfig | None = None,
        *,
        time: float = float("nan"),
        point_sigma_m: float = 0.005,
    ) -> None:
        """Plants of a map, made ready.

        Parameters
        ----------
        plants : one or several, as the map holds them or as landmarks of an instant.
        config : the options, defaults where None.
        time : s, of the frames to come: plants of a map drift up to it. NaN: as the map holds them.
        point_sigma_m : the usual error of a point an axis, for the size of the index.

        Raises
        ------
        InputError
            There is no plant, or one without flowers.
        """
        given = (plants,) if isinstance(plants, Landmarks | PlantMap) else tuple(plants)
        if not given:
            raise InputError("the map holds no plant, expected at least one to localise in")
        self.config = config or LocaliseConfig()
        self.plants = tuple(p if isinstance(p, Landmarks) else landmarks_at(p, time) for p in given)
        self.errors = ErrorScale(
            sway_m=self.config.sway_m,
            touched_m=self.config.touched_m,
            detection=self.config.detection,
            unmapped=self.config.unmapped,
        )
        self.point_sigma_m = point_sigma_m
        self._ready: dict[int, PlantIndex] = {}
        self.atlas = Atlas(self.plants, self._centroid_sigma()) if len(self.plants) > _MOST_TRIED else None

    def index(self, plant: int) -> PlantIndex:
        """The plant made ready for the search; the ones asked for last are kept."""
        if plant not in self._ready:
            if len(self._ready) >= _MOST_READY:
                del self._ready[next(iter(self._ready))]
            self._ready[plant] = PlantIndex(self.plants[plant], self._reach(self.plants[plant]))
        return self._ready[plant]

    def _reach(self, marks: Landmarks) -> float:
        own = np.trace(marks.shared_covs, axis1=1, axis2=2).mean() / 3.0
        return float(8.0 * np.sqrt(self.point_sigma_m**2 + own + self.config.sway_m**2))

    def _centroid_sigma(self) -> float:
        """How far a group of flowers is off an axis: by points, by sway, by what the map may be wrong by."""
        own = np.median([np.trace(p.shared_covs, axis1=1, axis2=2).mean() / 3.0 for p in self.plants])
        return float(np.sqrt(self.point_sigma_m**2 / 2.0 + own + self.config.sway_m**2))

    def locate(self, frame: Frame) -> Localisation:
        """Where a frame is seen from; its pose and stamp are not looked at."""
        return self.locate_points(frame.points, frame.covs)

    def locate_points(
        self, points: Array, covs: Array, *, scale: ErrorScale | None = None, among: Sequence[int] | None = None
    ) -> Localisation:
        """Where a frame with points (n, 3) and covariances (n, 3, 3) of the camera frame is seen from.

        ``among``: the plants (indices) that are looked at; None: all, or in a map of many those that the index names.

        Raises
        ------
        InputError
            A value is not finite or a covariance not positive definite.
        """
        scale = scale or self.errors
        look = make_look(points, covs, scale)
        if len(look) < 3:
            return self._answer(look, [])
        tried = self.likely_plants(look.points) if among is None else among
        for thorough in (False, True):
            found: list[Hypothesis] = []
            for plant in tried[:_MOST_THOROUGH] if thorough and self.atlas is not None else tried:
                found += self._in_plant(look, plant, scale, thorough)
            weighed = self._weighed(found)
            if weighed and weighed[0].probability >= self.config.sure_probability:
                break
        return self._answer(look, weighed)

    def likely_plants(self, points: Array) -> Sequence[int]:
        """Which plants (indices) points (n, 3) may show: all of a few; of many at most eight, the likeliest first."""
        if self.atlas is None:
            return range(len(self.plants))
        found = self.atlas.guesses(points)
        near = [g.plant for g in found if g.score > found[0].score - _NEAR_SCORE]
        return list(dict.fromkeys(near))[:_MOST_TRIED]

    def _in_plant(self, look: Look, plant: int, scale: ErrorScale, thorough: bool) -> list[Hypothesis]:
        index, marks = self.index(plant), self.plants[plant]
        poses, scores = rough_poses(look, index, scale, self.config, thorough=thorough)
        if len(poses) == 0:
            return []
        var = look.sigma**2 + index.var + scale.sway_m**2
        poses, scores = sharpened(poses, look, index, var)
        poses, scores = distinct(
            poses, scores, look, float(np.sqrt(var.mean())), self.config.n_refined * (5 if thorough else 1)
        )
        density = null_density(marks, look)
        out: list[Hypothesis] = []
        for T in poses[scores > scores.max() - _WORSE_BY]:
            fit = refine(look, marks, T, scale, density)
            if fit is not None and not any(_same(fit, other.fit) for other in out):
                out.append(Hypothesis(plant, fit, log_evidence(fit, look, marks, scale)))
        return out

    def _weighed(self, found: list[Hypothesis]) -> list[Hypothesis]:
        """Best first, with probabilities: of all poses found, and of none of them."""
        if not found:
            return []
        prior = self.config.map_prior / len(self.plants)
        logs = np.array([h.log_evidence + np.log(prior) for h in found] + [np.log1p(-self.config.map_prior)])
        p = np.exp(logs - logs.max())
        p = p / p.sum()
        order = np.argsort(-logs[:-1], kind="stable")
        return [replace(found[i], probability=float(p[i])) for i in order]

    def _answer(self, look: Look, found: list[Hypothesis]) -> Localisation:
        flowers, clusters = np.full(len(look), CLUTTER), np.full(len(look), CLUTTER)
        if not found:
            return Localisation("no_match" if len(look) >= 3 else "too_few", (), "", flowers, clusters)
        best = found[0]
        marks = self.plants[best.plant]
        flowers[best.fit.rows] = marks.flower_ids[best.fit.flowers]
        clusters[best.fit.rows] = marks.cluster_ids[best.fit.flowers]
        cov = marks.in_first_frame(best.fit.cov, best.fit.T_map_camera)
        return Localisation(self._reason(found), tuple(found), marks.plant, flowers, clusters, cov)

    def _reason(self, found: list[Hypothesis]) -> LostReason:
        config, best = self.config, found[0]
        if len(best.fit.clusters) < config.min_clusters or len(best.fit.rows) < config.min_flowers:
            return "too_few"
        if best.probability >= config.sure_probability:
            return ""
        inside = sum(h.probability for h in found)
        return "ambiguous" if inside >= 0.5 else "no_match"


def _same(a: Fit, b: Fit) -> bool:
    """Whether two fits are one: the same matches, or poses that lie within each other's errors."""
    if np.array_equal(a.rows, b.rows) and np.array_equal(a.flowers, b.flowers):
        return True
    moved = inverse(a.T_map_camera) @ b.T_map_camera
    if np.trace(moved[:3, :3]) < _TURNED:
        return False
    xi = se3_log(moved)
    return bool(xi @ (a.information @ xi) < 25.0 or xi @ (b.information @ xi) < 25.0)
