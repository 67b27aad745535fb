"""Smoothing all sessions of a plant together, and what that changes in the map."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.constellation.growth import DAY_S
from cluster_slam.geometry import Array, inverse, transform, tum_from_pose
from cluster_slam.graph.sessions import Sightings, Smoothed, smooth_sessions
from cluster_slam.io.map.rows import N_CLUSTER_COLUMNS, N_FLOWER_COLUMNS, cluster_rows, flower_rows
from cluster_slam.io.map.store import MapStore, StoredSession
from cluster_slam.io.map.write import upsert
from cluster_slam.records import IntArray, PlantMap

SIGMA_M = 0.003  # of a centroid, one sigma an axis: flowers come and go


@dataclass(frozen=True, slots=True)
class Optimised:
    """How well the sessions of a plant agree, before and after."""

    plant: str
    n_sessions: int
    n_sightings: int
    rms_before: float  # residuals over their sigma
    rms_after: float


def optimise_plant(store: MapStore, name: str) -> Optimised | None:
    """Smooth the sessions of a plant together and write what changed; None where there are fewer than two.

    Sessions before it can no longer be undone.

    Raises
    ------
    OutputError
        The map cannot be written: nothing has changed.
    """
    with store.write() as connection:
        plant, sessions = store.plant(name), store.sessions(name)
        if len(sessions) < 2:
            return None
        found, rows = _sightings(store, plant, sessions)
        T = np.array([s.T_map_world for s in sessions])
        smoothed = smooth_sessions(found, T, plant.drift_rate)
        moved = _moved(plant, rows, smoothed)
        plant_id = connection.execute("SELECT id FROM plants WHERE name = ?", (name,)).fetchone()[0]
        upsert(connection, "clusters", N_CLUSTER_COLUMNS, cluster_rows(moved, plant_id))
        upsert(connection, "flowers", N_FLOWER_COLUMNS, flower_rows(moved))
        for k, session in enumerate(sessions[1:], 1):
            values = (*tum_from_pose(smoothed.T_map_world[k]).tolist(), session.id)
            names = "tx=?, ty=?, tz=?, qx=?, qy=?, qz=?, qw=?"
            connection.execute(f"UPDATE sessions SET {names} WHERE id=?", values)
            _move_observations(connection, session, smoothed.T_map_world[k])
        connection.execute("DELETE FROM journal")
    return Optimised(name, len(sessions), len(found.session), smoothed.rms_before, smoothed.rms_after)


def _sightings(store: MapStore, plant: PlantMap, sessions: list[StoredSession]) -> tuple[Sightings, IntArray]:
    """What all sessions saw of clusters, and the rows of the plant's clusters in the order of the sightings' rows."""
    session, cluster, local, time = [], [], [], []
    for k, s in enumerate(sessions):
        seen = store.read(
            "SELECT cluster_id, x, y, z FROM observations WHERE session_id = ? AND x IS NOT NULL", (s.id,)
        )
        places = np.array([row[1:] for row in seen], dtype=float).reshape(-1, 3)
        session += [k] * len(seen)
        cluster += [row[0] for row in seen]
        local.append(transform(inverse(s.T_map_world), places))
        time += [0.0 if np.isnan(s.start) else s.start] * len(seen)
    ids, row = np.unique(np.array(cluster), return_inverse=True)
    first = np.full(len(ids), np.inf)
    np.minimum.at(first, row, np.array(time))
    days = (np.array(time) - first[row]) / DAY_S
    sigma = np.sqrt(SIGMA_M**2 + plant.walk_rate**2 * days)
    rows = np.searchsorted(plant.cluster_ids, ids).astype(np.int64)
    found = Sightings(np.array(session), row.astype(np.int64), np.concatenate(local), days, sigma)
    return found, rows


def _moved(plant: PlantMap, rows: IntArray, smoothed: Smoothed) -> PlantMap:
    """The plant with its clusters, and their flowers, where the smoothed drift has them at their own times."""
    days = np.nan_to_num((plant.cluster_time[rows] - plant.cluster_first_seen[rows]) / DAY_S)
    where = smoothed.positions + days[:, None] * smoothed.velocities
    shift = np.zeros_like(plant.clusters)
    shift[rows] = where - plant.clusters[rows]
    velocities, velocity_covs = plant.velocities.copy(), plant.velocity_covs.copy()
    several = days > 0
    velocities[rows[several]] = smoothed.velocities[several] / DAY_S
    velocity_covs[rows[several]] = smoothed.covs[several, 3:, 3:] / DAY_S**2
    shift = _limited(shift, plant)
    return replace(
        plant,
        clusters=plant.clusters + shift,
        flowers=plant.flowers + shift[plant.flower_rows],
        velocities=velocities,
        velocity_covs=velocity_covs,
    )


def _limited(shift: Array, plant: PlantMap) -> Array:
    """Shifts (c, 3), no longer than three sigmas and a centimetre: a centroid of other flowers is no drift."""
    sigma = np.sqrt(np.trace(plant.cluster_covs, axis1=1, axis2=2) / 3.0)
    length = np.linalg.norm(shift, axis=1)
    limit = 3.0 * sigma + 0.01
    limited: Array = shift * np.minimum(1.0, limit / np.maximum(length, 1e-12))[:, None]
    return limited


def _move_observations(connection: sqlite3.Connection, session: StoredSession, T: Array) -> None:
    """What a session saw, moved with its frame."""
    D = T @ inverse(session.T_map_world)
    for table in ("observations", "flower_observations"):
        rows = connection.execute(
            f"SELECT rowid, x, y, z FROM {table} WHERE session_id = ? AND x IS NOT NULL", (session.id,)
        ).fetchall()
        if rows:
            places = transform(D, np.array([row[1:] for row in rows], dtype=float)).round(6)
            values = [(*place, row[0]) for place, row in zip(places.tolist(), rows, strict=True)]
            connection.executemany(f"UPDATE {table} SET x=?, y=?, z=? WHERE rowid=?", values)
