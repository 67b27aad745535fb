"""Swaying clusters predicted one frame ahead, and clusters hidden for ten seconds while their neighbours sway.

    python benchmarks/bench_track_drift.py --seeds 31 32 --trials 40

Drift: frames in which a cluster has been followed as swaying for 0.3 s and truly swings by more than 1 cm. NIS: squared
innovation of the centroid over its covariance, 3 on average where that is true. RMSE: of the position predicted by the
filter and of "stays where it was", both in the world against the true centroid of the same flowers (the median error of
a cluster, the same for both, taken out).
Hidden: one cluster's points are left out for ten seconds; it must come back under its own id within a second.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from bench_track import calibration_of
from figure import Figure
from scipy.ndimage import maximum_filter1d

from cluster_slam.live.replay import Replay
from cluster_slam.online import OnlineTracker
from cluster_slam.online import tracker as steps
from cluster_slam.online.associate import Seen
from cluster_slam.online.world import World
from cluster_slam.simulate import PRESETS, simulate_session
from tracking.consistency import mean_band

LEAST_M = 0.01  # of the swing
SWAY = {"sway_m": 0.05, "sway_frequency_min_hz": 1.0, "sway_frequency_max_hz": 2.0}


def drift(seed: int) -> tuple[list[float], list[float], list[float]]:
    """NIS, and squared errors of the prediction and of "stays", of one session."""
    world = simulate_session(replace(PRESETS["moderate"], touches_per_minute=20.0, **SWAY), seed=seed)
    nis: list[float] = []
    errors: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
    flowers_of: dict[tuple[int, int], list[tuple[int, ...]]] = {}
    votes: dict[int, list[int]] = {}
    size = np.linalg.norm(world.motion.displacements, axis=2)
    half = round(0.5 / world.config.sway_frequency_min_hz * world.config.fps)  # frames of half a swing
    swing = maximum_filter1d(size, 2 * half + 1, axis=0)
    before: dict[int, tuple[tuple[int, ...], np.ndarray]] = {}
    since: dict[int, float] = {}
    follow = steps.follow
    now: dict[str, Any] = {}

    def watched(w: World, seen: Seen, points: np.ndarray, S: np.ndarray, stamp: float) -> None:
        slots = w.flowers.slot[seen.rows]
        shown = world.truth.flower_ids[now["rows"][seen.cols]].tolist()
        for flower, true in zip(w.flowers.ids[seen.rows].tolist(), shown, strict=True):
            votes.setdefault(flower, []).append(true)
        for k, slot in enumerate(seen.pose.slots.tolist()):
            cluster, at = w.clusters[slot], seen.at
            names = world.truth.cluster_ids[now["rows"][seen.cols[slots == slot]]]
            names = names[names >= 0]
            is_fresh = stamp - cluster.last < 1.5 * w.usual_dt
            if not (cluster.is_moving and "elsewhere" not in cluster.why and is_fresh and len(names)):
                since.pop(cluster.id, None)
                before.pop(cluster.id, None)
                continue
            since.setdefault(cluster.id, stamp)
            name = np.bincount(names).argmax()
            displaced = world.motion.displacements[now["frame"], name]
            shift, cov = seen.pose.shift[k], seen.pose.shift_cov[k]
            flowers, was_at = before.get(cluster.id, ((), np.zeros(3)))
            is_same = flowers == members(w, slot)
            if stamp - since[cluster.id] > 0.3 and swing[now["frame"], name] > LEAST_M and is_same:
                nis.append(float(shift @ np.linalg.solve(cov + at.P[slot], shift)))
                key = cluster.id, int(name)
                predicted = at.anchor[slot] + at.d[slot] - displaced, was_at - displaced
                errors.setdefault(key, []).append(predicted)
                flowers_of.setdefault(key, []).append(flowers)
        follow(w, seen, points, S, stamp)
        for slot in seen.pose.slots.tolist():
            cluster = w.clusters[slot]
            if cluster.is_moving and cluster.filter is not None and cluster.anchor is not None:
                before[cluster.id] = members(w, slot), cluster.filter.x[:3].copy()

    steps.follow = watched  # type: ignore[assignment]
    try:
        session = world.session
        tracker = OnlineTracker(session.noise, session.T_flange_camera, calibration=calibration_of(world, seed))
        order = np.argsort(session.observations.frame, kind="stable")
        n_before = 0
        for i, frame in enumerate(Replay(session).frames()):
            now["frame"], now["rows"] = i, order[n_before : n_before + len(frame)]
            n_before += len(frame)
            tracker.step(frame)
    finally:
        steps.follow = follow
    ahead, still = [], []
    places = dict(zip(world.truth.rest_flower_ids.tolist(), world.truth.rest_positions, strict=True))
    shows = {f: max(set(v), key=v.count) for f, v in votes.items()}
    for key, of_cluster in errors.items():
        centroids = np.array([centroid(places, shows, flowers) for flowers in flowers_of[key]])
        pairs = (np.array(of_cluster) - centroids[:, None])[np.isfinite(centroids[:, 0])]  # (n, 2, 3)
        if not len(pairs):
            continue
        pairs -= np.median(pairs[:, :1], axis=0)
        ahead += (pairs[:, 0] ** 2).sum(1).tolist()
        still += (pairs[:, 1] ** 2).sum(1).tolist()
    return nis, ahead, still


def members(world: World, slot: int) -> tuple[int, ...]:
    """The flowers whose centroid is followed; with others it is another one."""
    table = world.flowers
    return tuple(table.ids[(table.slot == slot) & table.confirmed].tolist())


def centroid(places: dict[int, np.ndarray], shows: dict[int, int], flowers: tuple[int, ...]) -> np.ndarray:
    """Where these flowers truly have their centroid at rest; NaN where one of them shows none."""
    true = [places.get(shows.get(flower, -1), np.full(3, np.nan)) for flower in flowers]
    return np.mean(true, axis=0)


def hidden(seed: int) -> tuple[int, int]:
    """How often a hidden cluster came back as itself, and how often one was hidden and came back at all."""
    world = simulate_session(replace(PRESETS["moderate"], duration_s=16.0, n_leaves=0, turn_rad=0.25), seed=seed)
    session, truth = world.session, world.truth
    seen, begin = session.observations, session.stamps[0]
    order = np.argsort(seen.frame, kind="stable")
    clusters = truth.cluster_ids[order]
    when = session.stamps[seen.frame[order]] - begin
    early, late = clusters[(when > 2.5) & (when < 3.0)], clusters[(when > 13.0) & (when < 14.0)]
    right = total = 0
    for victim in sorted(set(early.tolist()) & set(late.tolist()) - {-1}):
        if (truth.cluster_ids == victim).sum() < 3 or total >= 4:
            continue
        tracker = OnlineTracker(session.noise, session.T_flange_camera, calibration=calibration_of(world, seed))
        at, name_before, names_after = 0, -1, []
        for frame in Replay(session).frames():
            t, rows = frame.stamp - begin, order[at : at + len(frame)]
            at += len(frame)
            is_victim = truth.cluster_ids[rows] == victim
            keep = ~is_victim if 3.0 <= t < 13.0 else np.ones(len(rows), bool)
            update = tracker.step(replace(frame, points=frame.points[keep], covs=frame.covs[keep], scores=None))
            names = update.cluster_ids[is_victim[keep]]
            names = names[names >= 0]
            if t < 3.0 and len(names):
                name_before = int(np.bincount(names).argmax())
            elif 13.0 <= t < 14.0:
                names_after += names.tolist()
            if t >= 14.0:
                break
        if name_before >= 0 and names_after:
            total += 1
            right += int(np.bincount(names_after).argmax()) == name_before
    return right, total


def measure(quick: bool) -> list[Figure]:
    """Error of the prediction over that of "stays", in swings of more than a centimetre."""
    if quick:
        return []
    nis, ahead, still = (np.array(part) for part in drift(31))
    return [
        Figure("track: mean NIS of swaying clusters over 3", float(nis.mean()) / 3.0, ""),
        Figure(
            "track: error one frame ahead over that of staying", float(np.sqrt(ahead.mean() / still.mean())), "", 0.5
        ),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[31, 32])
    parser.add_argument("--trials", type=int, default=20)
    options = parser.parse_args()
    found = [drift(seed) for seed in options.seeds]
    nis, moved, stayed = (np.concatenate([f[i] for f in found]) for i in range(3))
    band = mean_band(3, len(nis))
    print(f"sway of 1 to 2 Hz, {len(nis)} predictions: NIS {nis.mean():.2f}, band {band.low:.2f} to {band.high:.2f}")
    print(f"median NIS {np.median(nis):.2f} (2.37 where true)")
    ahead, still = (1e3 * float(np.sqrt(max(e.mean(), 0.0))) for e in (moved, stayed))
    print(f"RMSE predicted {ahead:.2f} mm, stays {still:.2f} mm", flush=True)
    right = total = 0
    seed = 100
    while total < options.trials:
        r, n = hidden(seed)
        right, total, seed = right + r, total + n, seed + 1
    print(f"hidden for 10 s: {right} of {total} came back as themselves")


if __name__ == "__main__":
    main()
