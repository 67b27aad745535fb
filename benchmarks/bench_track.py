"""How good live tracking is on simulated plants: identities, trajectory, drift, time a frame.

    python benchmarks/bench_track.py moderate hard moderate-odometry --seeds 31 32

Each row is one session; with ``--calibration`` the hand-eye transform is the true one, known to 0.2 mm and 0.3 mrad (as
``smooth`` finds it), else it is found on the way. Times are processor time. Drift is measured on clusters that truly
sway by more than 3 mm: squared innovations over their covariance (3 where true), and the root mean square error of the
position predicted one frame ahead, beside that of "stays where it was", both against the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from time import process_time
from typing import Any

import numpy as np
from figure import Figure

from cluster_slam.evaluation.trajectory import hand_eye_truth
from cluster_slam.geometry import se3_exp
from cluster_slam.live.replay import Replay
from cluster_slam.online import OnlineTracker
from cluster_slam.records import Calibration, Session
from cluster_slam.simulate import PRESETS, Simulated, simulate_session
from tracking.metrics import hota, identity_scores
from tracking.ukf import UnscentedFilter

SIGMA = np.repeat([3e-4, 2e-4], 3)


@dataclass(frozen=True)
class Row:
    """What one session gave."""

    name: str
    seed: int
    flower: float
    cluster: float
    flower_hota: float
    cluster_hota: float
    ate_mm: float
    switches: int
    p50_ms: float
    p99_ms: float
    filterpy: float  # share of the time


class Clock:
    """Processor time spent in filterpy's filter while it is entered."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._methods = {name: getattr(UnscentedFilter, name) for name in ("predict", "update")}

    def __enter__(self) -> Clock:
        for name, method in self._methods.items():
            setattr(UnscentedFilter, name, self._timed(method))
        return self

    def __exit__(self, *_: object) -> None:
        for name, method in self._methods.items():
            setattr(UnscentedFilter, name, method)

    def _timed(self, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            begun = process_time()
            try:
                return method(*arguments)
            finally:
                self.seconds += process_time() - begun

        return timed


def calibration_of(world: Simulated, seed: int) -> Calibration | None:
    true = hand_eye_truth(world.session, world.truth)
    if true is None:
        return None
    error = np.random.default_rng(seed).normal(size=6) * SIGMA
    return Calibration(true.T_flange_camera @ se3_exp(error), np.diag(SIGMA**2))


def switches(true: np.ndarray, found: np.ndarray, frame: np.ndarray) -> int:
    """How often a true flower's label differs from the last that it had (clutter does not count)."""
    n = 0
    order = np.argsort(frame, kind="stable")
    last: dict[int, int] = {}
    for t, f in zip(true[order].tolist(), found[order].tolist(), strict=True):
        if t >= 0 and f >= 0:
            n += last.get(t, f) != f
            last[t] = f
    return n


def nearest_within(session: Session, radius: float) -> np.ndarray:
    """The 5 cm rule: a point is the last known flower within the radius, one to one by distance, or a new one."""
    T, seen = session.T_world_camera, session.observations
    labels, places = np.full(len(seen), -1), np.zeros((0, 3))
    order = np.argsort(seen.frame, kind="stable")
    bounds = np.searchsorted(seen.frame[order], np.arange(session.n_frames + 1))
    for i in range(session.n_frames):
        rows = order[bounds[i] : bounds[i + 1]]
        w = seen.points[rows] @ T[i, :3, :3].T + T[i, :3, 3]
        gap = np.linalg.norm(w[:, None] - places[None], axis=-1) if len(places) else np.zeros((len(w), 0))
        free_row, free_col = np.ones(len(w), bool), np.ones(len(places), bool)
        for flat in np.argsort(gap, axis=None):
            r, c = np.unravel_index(flat, gap.shape)
            if gap[r, c] > radius:
                break
            if free_row[r] and free_col[c]:
                labels[rows[r]], free_row[r], free_col[c] = c, False, False
                places[c] = w[r]
        new = np.flatnonzero(free_row)
        labels[rows[new]] = len(places) + np.arange(len(new))
        places = np.concatenate([places, w[new]])
    return labels


def run(name: str, seed: int, after_s: float, calibrated: bool) -> tuple[Row, int]:
    world = simulate_session(PRESETS[name], seed=seed)
    session, truth = world.session, world.truth
    given = calibration_of(world, seed) if calibrated else None
    tracker = OnlineTracker(session.noise, session.T_flange_camera, calibration=given, pose_error=session.pose_error)
    seen = session.observations
    order = np.argsort(seen.frame, kind="stable")
    flowers, clusters, T, times, at = np.full(len(seen), -1), np.full(len(seen), -1), [], [], 0
    with Clock() as clock:
        for frame in Replay(session).frames():
            begun = process_time()
            update = tracker.step(frame)
            times.append(process_time() - begun)
            rows = order[at : at + len(frame)]
            flowers[rows], clusters[rows], at = update.flower_ids, update.cluster_ids, at + len(frame)
            T.append(update.T_world_camera)
    counted = session.stamps[seen.frame] - session.stamps[0] >= after_s
    from cluster_slam.evaluation.trajectory import absolute_error, aligned, alignment

    late = session.stamps - session.stamps[0] >= after_s
    true = truth.T_world_camera[late]
    found = np.array(T)[late]
    error = absolute_error(aligned(alignment(found, true), found), true)
    t, c = truth.flower_ids[counted], truth.cluster_ids[counted]
    row = Row(
        name,
        seed,
        identity_scores(t, flowers[counted]).idf1,
        identity_scores(c, clusters[counted]).idf1,
        hota(t, flowers[counted]).hota,
        hota(c, clusters[counted]).hota,
        1e3 * error.position_m,
        switches(truth.flower_ids, flowers, seen.frame),
        1e3 * float(np.percentile(times, 50)),
        1e3 * float(np.percentile(times, 99)),
        clock.seconds / sum(times),
    )
    return row, switches(truth.flower_ids, nearest_within(session, 0.05), seen.frame)


def measure(quick: bool) -> list[Figure]:
    """The moderate world with a calibration."""
    found, _ = run("sample" if quick else "moderate", 31, 0.0, True)
    return [
        Figure(f"track {found.name}: 1 - flower IDF1", 1.0 - found.flower, "", None if quick else 0.03),
        Figure(f"track {found.name}: 1 - cluster IDF1", 1.0 - found.cluster, "", None if quick else 0.01),
        Figure(f"track {found.name}: processor time of a frame, median", found.p50_ms, "ms", 15.0),
        Figure(f"track {found.name}: processor time of a frame, one in a hundred", found.p99_ms, "ms", 33.0),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("presets", nargs="+")
    parser.add_argument("--seeds", nargs="+", type=int, default=[31])
    parser.add_argument("--after", type=float, default=0.0, help="seconds that are not counted")
    parser.add_argument("--calibration", action="store_true")
    options = parser.parse_args()
    head = "preset                seed  flower  cluster  HOTA f  HOTA c   ATE mm"
    print(head, " switches (5 cm rule)   p50   p99 ms filterpy")
    for name in options.presets:
        for seed in options.seeds:
            r, naive = run(name, seed, options.after, options.calibration)
            scores = f"{r.flower:.4f}   {r.cluster:.4f}  {r.flower_hota:.4f}  {r.cluster_hota:.4f}  {r.ate_mm:6.3f}"
            times = f"{r.p50_ms:5.1f} {r.p99_ms:5.1f} {r.filterpy:6.1%}"
            print(f"{name:21s} {seed:4d}  {scores}  {r.switches:8d} ({naive:8d})     {times}", flush=True)


if __name__ == "__main__":
    main()
