"""Live tracking beside public trackers, on the same detections: Stone Soup (GNN, JPDA, with a UKF), norfair, 5 cm rule.

    pip install -c constraints.txt -e '.[bench]' && pip install --no-deps norfair==2.3.0
    python benchmarks/bench_track_peers.py moderate --seed 82 --frames 300

(norfair's metadata ask for NumPy 1 and filterpy 1.4; it runs with those of today.) Peers know nothing of arms and
clusters: they get the points in the world, by the given poses and the calibrated hand-eye transform, with the
covariance of each point and of the pose. Each is run with the settings below, which were chosen on seed 81. All say,
frame by frame, which track each point belongs to (IDF1, HOTA of flowers) and where the tracks seen in the frame are
(GOSPA, cut-off 5 cm, mean over the frames). Times are processor time a frame.
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import process_time
from typing import Any

import numpy as np
from bench_track import calibration_of, switches
from figure import Figure

from cluster_slam.geometry import rotate_cov, transform
from cluster_slam.live.replay import Replay
from cluster_slam.online import OnlineTracker
from cluster_slam.records import Frame
from cluster_slam.simulate import PRESETS, Simulated, simulate_session
from tracking.metrics import gospa, hota, identity_scores

CUTOFF_M = 0.05
NEAR_M = 0.05  # of the rule
ACCEL = 0.005  # m^2/s^3: spectral density of the peers' constant-velocity model
FORGET = 20  # frames without an update after which Stone Soup's tracks end; with 45 and 90 it is worse


@dataclass(frozen=True)
class Said:
    """Of one frame: a track for each point (-1: none), and where each track that was seen is."""

    labels: np.ndarray
    places: np.ndarray


class Ours:
    """This project's tracker; a flower is where its place at rest and its cluster's displacement put it."""

    def __init__(self, world: Simulated, seed: int) -> None:
        s = world.session
        given = calibration_of(world, seed)
        self._tracker = OnlineTracker(s.noise, s.T_flange_camera, calibration=given, pose_error=s.pose_error)

    def step(self, frame: Frame, _points: np.ndarray, _covs: np.ndarray) -> Said:
        labels = self._tracker.step(frame).flower_ids
        table, world = self._tracker.world.flowers, self._tracker.world
        rows = np.flatnonzero(np.isin(table.ids, labels[labels >= 0]))
        d = np.array([k.now(self._tracker.last_stamp)[0] - k.anchor for k in world.clusters])
        return Said(labels, table.place[rows] + d[table.slot[rows]])


class Nearest:
    """The 5 cm rule: a point is the nearest track within 5 cm of where that was last seen, one to one, or a new one."""

    def __init__(self) -> None:
        self._places = np.zeros((0, 3))

    def step(self, _frame: Frame, points: np.ndarray, _covs: np.ndarray) -> Said:
        gap = np.linalg.norm(points[:, None] - self._places[None], axis=-1)
        labels, taken = np.full(len(points), -1), np.zeros(len(self._places), bool)
        for flat in np.argsort(gap, axis=None):
            r, c = np.unravel_index(flat, gap.shape)
            if gap[r, c] > NEAR_M:
                break
            if labels[r] < 0 and not taken[c]:
                labels[r], taken[c] = c, True
        new = np.flatnonzero(labels < 0)
        labels[new] = len(self._places) + np.arange(len(new))
        self._places = np.concatenate([self._places, points[new]])
        self._places[labels] = points
        return Said(labels, points)


class Norfair:
    """norfair with its own Kalman filter, a gate of 3 cm, and a memory of three seconds."""

    def __init__(self) -> None:
        from norfair import Tracker

        self._tracker = Tracker(
            lambda detection, track: float(np.linalg.norm(detection.points - track.estimate)),
            distance_threshold=0.03,
            hit_counter_max=90,
            initialization_delay=2,
        )

    def step(self, _frame: Frame, points: np.ndarray, _covs: np.ndarray) -> Said:
        from norfair import Detection

        given = [Detection(points=p[None], data=k) for k, p in enumerate(points)]
        labels, places = np.full(len(points), -1), []
        for track in self._tracker.update(given):
            if any(track.last_detection is one for one in given):
                labels[track.last_detection.data] = track.id
                places.append(track.estimate[0])
        return Said(labels, np.array(places).reshape(-1, 3))


class StoneSoup:
    """Stone Soup's multi-target tracker with constant velocity, a UKF, and GNN or JPDA.

    JPDA is the one by efficient hypothesis management: the same probabilities, without listing every joint hypothesis
    (of some forty tracks these are too many).
    """

    def __init__(self, kind: str, clutter_density: float) -> None:
        from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
        from stonesoup.dataassociator.probability import JPDAwithEHM2
        from stonesoup.deleter.time import UpdateTimeStepsDeleter
        from stonesoup.hypothesiser.distance import DistanceHypothesiser
        from stonesoup.hypothesiser.probability import PDAHypothesiser
        from stonesoup.initiator.simple import MultiMeasurementInitiator
        from stonesoup.measures import Mahalanobis
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
        from stonesoup.predictor.kalman import UnscentedKalmanPredictor
        from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
        from stonesoup.types.state import GaussianState
        from stonesoup.updater.kalman import UnscentedKalmanUpdater

        motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(ACCEL)] * 3)
        self._measures = LinearGaussian
        predictor, updater = UnscentedKalmanPredictor(motion), UnscentedKalmanUpdater(None)
        nearest = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=4.0)
        likeliest = PDAHypothesiser(predictor, updater, clutter_density, prob_detect=0.9, prob_gate=0.999)
        associator: Any = GNNWith2DAssignment(nearest) if kind == "GNN" else JPDAwithEHM2(likeliest)
        prior = GaussianState(np.zeros((6, 1)), np.diag([1.0, 0.01] * 3), timestamp=None)
        initiator = MultiMeasurementInitiator(
            prior, UpdateTimeStepsDeleter(4), GNNWith2DAssignment(nearest), updater, min_points=3
        )
        make = MultiTargetTracker if kind == "GNN" else MultiTargetMixtureTracker
        self._waiting: list[Any] = []
        self._tracker = make(initiator, UpdateTimeStepsDeleter(FORGET), self._detections(), associator, updater)
        self._steps = iter(self._tracker)
        self._ids: dict[str, int] = {}

    def _detections(self) -> Iterator[Any]:
        while True:
            yield self._waiting.pop()

    def step(self, frame: Frame, points: np.ndarray, covs: np.ndarray) -> Said:
        from stonesoup.types.detection import Detection

        now = datetime.datetime(2026, 1, 1) + datetime.timedelta(seconds=frame.stamp)
        model = [self._measures(6, (0, 2, 4), cov) for cov in covs]
        given = [
            Detection(p[:, None], timestamp=now, measurement_model=m, metadata={"row": k})
            for k, (p, m) in enumerate(zip(points, model, strict=True))
        ]
        self._waiting.append((now, set(given)))
        _, tracks = next(self._steps)
        labels, places = np.full(len(points), -1), []
        for track in sorted(tracks, key=lambda t: t.id):
            hypothesis = getattr(track[-1], "hypothesis", None)
            if hypothesis is None or track[-1].timestamp != now:
                continue
            label = self._ids.setdefault(track.id, len(self._ids))
            best = max(hypothesis, key=lambda h: h.weight) if hasattr(hypothesis, "__iter__") else hypothesis
            if best:
                labels[best.measurement.metadata["row"]] = label
                places.append(np.asarray(track[-1].state_vector, float).ravel()[::2])
        return Said(labels, np.array(places).reshape(-1, 3))


@dataclass(frozen=True)
class Row:
    """What one tracker reached."""

    name: str
    idf1: float
    hota: float
    gospa_mm: float
    switches: int
    mean_ms: float


def run(name: str, tracker: Any, world: Simulated, seed: int, n_frames: int) -> Row:
    session, truth = world.session, world.truth
    seen, calibration = session.observations, calibration_of(world, seed)
    X = np.eye(4) if calibration is None else calibration.T_flange_camera
    order = np.argsort(seen.frame, kind="stable")
    labels, distances, seconds, at = [], [], 0.0, 0
    for i, frame in enumerate(Replay(session).frames()):
        if i >= n_frames:
            break
        T = session.poses[i] @ X
        points = transform(T, frame.points)
        far = np.hypot(
            session.noise.pose_translation, session.noise.pose_rotation * np.linalg.norm(frame.points, axis=1)
        )
        covs = rotate_cov(T[:3, :3], frame.covs) + (far**2)[:, None, None] * np.eye(3)
        begun = process_time()
        said = tracker.step(frame, points, covs)
        seconds += process_time() - begun
        rows = order[at : at + len(frame)]
        at += len(frame)
        labels.append(said.labels)
        flowers = truth.flower_ids[rows]
        flowers = flowers[flowers >= 0]
        distances.append(gospa(world.flower_positions[i][flowers], said.places, CUTOFF_M).total)
    true, found = truth.flower_ids[order[:at]], np.concatenate(labels)
    return Row(
        name,
        identity_scores(true, found).idf1,
        hota(true, found).hota,
        1e3 * float(np.mean(distances)),
        switches(true, found, seen.frame[order[:at]]),
        1e3 * seconds / n_frames,
    )


def rows(preset: str, seed: int, n_frames: int, names: list[str]) -> Iterator[Row]:
    world = simulate_session(replace(PRESETS[preset], duration_s=n_frames / PRESETS[preset].fps), seed=seed)
    n_frames = min(n_frames, world.session.n_frames)
    volume = float(np.prod(np.ptp(world.session.observations.points, axis=0)))
    density = PRESETS[preset].clutter_per_frame / volume
    makers = {
        "ours": lambda: Ours(world, seed),
        "5 cm rule": Nearest,
        "norfair": Norfair,
        "Stone Soup GNN": lambda: StoneSoup("GNN", density),
        "Stone Soup JPDA": lambda: StoneSoup("JPDA", density),
    }
    for name in names or list(makers):
        yield run(name, makers[name](), world, seed, n_frames)


def measure(quick: bool) -> list[Figure]:
    """Ours and the rule, which need nothing else."""
    figures = []
    for row in rows("moderate", 82, 90 if quick else 300, ["ours", "5 cm rule"]):
        figures.append(Figure(f"track, {row.name}: 1 - flower IDF1", 1.0 - row.idf1, ""))
        figures.append(Figure(f"track, {row.name}: GOSPA", row.gospa_mm, "mm"))
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("preset", nargs="?", default="moderate")
    parser.add_argument("--seed", type=int, default=82)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--only", nargs="*", default=[], metavar="NAME")
    asked = parser.parse_args()
    print(f"{asked.preset}, seed {asked.seed}, first {asked.frames} frames")
    print("tracker            flower IDF1    HOTA   GOSPA mm  switches  ms a frame")
    for r in rows(asked.preset, asked.seed, asked.frames, asked.only):
        print(
            f"{r.name:18} {r.idf1:11.4f} {r.hota:7.4f} {r.gospa_mm:10.2f} {r.switches:9d} {r.mean_ms:11.1f}", flush=True
        )


if __name__ == "__main__":
    main()
