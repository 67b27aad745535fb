"""From a running tracker to a result: rows as they were said at the time, the map as it stands at the end."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from cluster_slam.association.frames import sort_by_frame
from cluster_slam.geometry import pose_from_tum
from cluster_slam.landmark_tables import RestMap, cluster_table, flower_table
from cluster_slam.online.journal import Told
from cluster_slam.online.tracker import OnlineTracker
from cluster_slam.records import Calibration, Clusters, Diagnostics, Drift, Flowers, IntArray, Result, Session, State

_TOLD_APART = 0.5  # of how far flowers stand apart: an error, one sigma, that takes one for another
_DRIFTING = (
    "poses drift: what odometry errs over the whole way is not in the covariances of places and poses, and where "
    "the way comes back to a place nothing is corrected; smoothing the session does both"
)


def make_result(session: Session, tracker: OnlineTracker, told: Told, timings: dict[str, float]) -> Result:
    """The result of a session all of whose frames have been told.

    ``told.rows`` come frame by frame; they are brought back to the order of the session's observations.
    """
    seen = session.observations
    order = np.argsort(seen.frame, kind="stable")
    flower_ids, cluster_ids = (np.full(len(seen), -1, dtype=np.int64) for _ in range(2))
    reasons, nis = np.zeros(len(seen), dtype=np.int64), np.full(len(seen), np.nan)
    flower_ids[order], cluster_ids[order] = told.rows["flower"], told.rows["cluster"]
    reasons[order], nis[order] = told.rows["reason"], told.rows["nis"]
    flowers, clusters = _tables(session, tracker, flower_ids)
    poor = (*_shortcomings(flower_ids, len(flowers)), *_astray(tracker, flowers))
    drifting = (_DRIFTING,) if session.pose_error == "odometry" else ()
    warnings = (*session.warnings, *poor, *drifting, *(text.partition(" ")[2] for text in told.warnings))
    return Result(
        session=session,
        T_world_camera=pose_from_tum(told.frames["pose"].astype(np.float64)),
        flower_ids=flower_ids,
        cluster_ids=cluster_ids,
        flowers=flowers,
        clusters=clusters,
        drift=Drift(
            frame=told.drift["frame"].astype(np.int64),
            cluster_ids=told.drift["cluster"].astype(np.int64),
            positions=told.drift["position"].astype(np.float64),
            covs=told.drift["cov"].astype(np.float64),
        ),
        calibration=_calibration(tracker),
        diagnostics=Diagnostics(
            nis=nis, reasons=reasons, estimated_noise={"flower_factor": float(np.sqrt(tracker.noise_watch.factor))}
        ),
        command="track",
        config=asdict(tracker.config),
        timings_s=timings,
        counts={
            "frames": session.n_frames,
            "observations": len(seen),
            "flowers": len(flowers),
            "clusters": len(clusters),
            "clutter": int((flower_ids < 0).sum()),
            "merged": len(tracker.world.merged),
            "revisions": len(told.revisions),
        },
        warnings=tuple(dict.fromkeys(warnings)),
        merged=tuple(tracker.world.merged),
        status="poor" if poor else "ok",
    )


def _tables(session: Session, tracker: OnlineTracker, flower_ids: IntArray) -> tuple[Flowers, Clusters]:
    """The confirmed flowers and their clusters, in the order of their ids."""
    table = tracker.world.flowers
    rows = np.flatnonzero(table.confirmed)
    rows = rows[np.argsort(table.ids[rows])]
    ids = table.ids[rows]
    names = np.array([k.id for k in tracker.world.clusters], dtype=np.int64)
    used, cluster = np.unique(names[table.slot[rows]], return_inverse=True)
    frames = sort_by_frame(session.observations, session.stamps)
    rest = RestMap(table.place[rows], tracker.joint_cov(rows), cluster, rows_of(flower_ids[frames.order], ids, tracker))
    flowers = flower_table(rest, frames)
    slot_of = {k.id: k for k in tracker.world.clusters}
    clusters = cluster_table(rest, frames, np.ones(len(used), dtype=bool))
    states: tuple[State, ...] = tuple(slot_of[i].state for i in used.tolist())
    first, last = table.first[rows], table.last[rows]
    flowers = replace(
        flowers,
        ids=ids,
        cluster_ids=used[cluster],
        first_seen=np.where(np.isfinite(flowers.first_seen), flowers.first_seen, first),
        last_seen=np.where(np.isfinite(flowers.last_seen), flowers.last_seen, last),
    )
    return flowers, replace(clusters, ids=used, states=states)


def rows_of(labels: IntArray, ids: IntArray, tracker: OnlineTracker) -> IntArray:
    """Row among ``ids`` of each label (m,), merged ones by what they became; -1 for those that are no more."""
    into = dict(tracker.world.merged)
    known = np.unique(labels)
    final = []
    for label in known.tolist():
        while label in into:
            label = into[label]
        final.append(label)
    row = {int(i): k for k, i in enumerate(ids.tolist())}
    number = np.array([row.get(i, -1) for i in final], dtype=np.int64)
    return number[np.searchsorted(known, labels)] if len(known) else np.zeros(0, dtype=np.int64)


def _noise(tracker: OnlineTracker) -> dict[str, float]:
    return {"flower_factor": float(np.sqrt(tracker.noise_watch.factor))}


def _calibration(tracker: OnlineTracker) -> Calibration | None:
    return None if tracker.X is None else Calibration(tracker.X, tracker.cov_X)


def _astray(tracker: OnlineTracker, flowers: Flowers) -> tuple[str, ...]:
    """That the way was lost, where odometry alone led it farther than flowers stand apart."""
    if len(flowers) < 2:
        return ()
    gap = np.linalg.norm(flowers.positions[:, None] - flowers.positions[None], axis=-1)
    np.fill_diagonal(gap, np.inf)
    spacing, astray = float(np.median(gap.min(0))), tracker.astray_watch.most_m
    if astray < _TOLD_APART * spacing:
        return ()
    return (
        f"lost: where fewer than three known flowers were in view, odometry may have erred by {astray:.2g} m; "
        f"flowers stand {spacing:.2g} m apart: identities and places from there on are not to be relied on",
    )


def _shortcomings(flower_ids: IntArray, n_flowers: int) -> tuple[str, ...]:
    if len(flower_ids) == 0:
        return ("no flowers in the session: there is nothing to follow",)
    share = float((flower_ids >= 0).mean())
    if share == 0.0 or n_flowers == 0:
        return (f"none of the {len(flower_ids)} observations was seen again: no flower could be confirmed",)
    if share < 0.5:
        return (f"only {100 * share:.0f} % of the observations belong to a flower: the rest was taken for false ones",)
    return ()
