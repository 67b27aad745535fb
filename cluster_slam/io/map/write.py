"""Putting a session into a map, and taking the latest one out again, each in one transaction."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass
from typing import Any

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.map.journal import packed, unpacked
from cluster_slam.io.map.rows import N_CLUSTER_COLUMNS, N_FLOWER_COLUMNS, Row, cluster_rows, flower_rows
from cluster_slam.io.map.store import MapStore, StoredSession
from cluster_slam.records import BoolArray, Constellation, IntArray, PlantMap

JOURNAL_SESSIONS = 20  # so many sessions can be undone, one after another ...
JOURNAL_BYTES = 1_000_000  # ... as long as what that needs is no larger; the latest one always can


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """All that one session puts into a map."""

    plant: PlantMap  # as it is after the session
    session: Constellation
    kind: str
    digest: str
    T_map_world: Array  # (4, 4)
    scale: float
    cov: Array  # (6, 6)
    evidence: float  # NaN for a plant's first session
    probability: float
    cluster_map_ids: IntArray  # (c,)
    cluster_probability: Array  # (c,)
    cluster_is_new: BoolArray  # (c,)
    flower_map_ids: IntArray  # (f,)
    flower_probability: Array  # (f,)
    flower_is_new: BoolArray  # (f,)
    flowers: Array  # (f, 3) map
    missed: IntArray  # map ids of clusters that were looked at and not seen
    viewpoint: Array | None  # (3,) mean camera position, map


def next_ids(store: MapStore) -> tuple[int, int]:
    """The first free ids of clusters and flowers."""
    counters: dict[str, int] = dict(store.read("SELECT name, next FROM counters"))
    return int(counters["clusters"]), int(counters["flowers"])


def put(connection: sqlite3.Connection, entry: Entry) -> None:
    """Write a session within a transaction of :meth:`MapStore.write`."""
    plant_id, before = _plant(connection, entry)
    session_id = connection.execute("SELECT coalesce(max(id), 0) + 1 FROM sessions").fetchone()[0]
    changed = _changed(connection, entry.plant, plant_id)
    _session(connection, entry, session_id, plant_id)
    upsert(connection, "clusters", N_CLUSTER_COLUMNS, changed["clusters"][0])
    upsert(connection, "flowers", N_FLOWER_COLUMNS, changed["flowers"][0])
    _observations(connection, entry, session_id)
    _count_up(connection, entry.plant)
    journal = {"plant": before, **{name: rows for name, (_, rows) in changed.items()}}
    connection.execute("INSERT INTO journal VALUES (?, ?)", (session_id, packed(journal)))
    _prune(connection)


def _plant(connection: sqlite3.Connection, entry: Entry) -> tuple[int, Row | None]:
    """Id of the plant's row, written anew, and the row as it was (None: there was none)."""
    before = connection.execute("SELECT * FROM plants WHERE name = ?", (entry.plant.name,)).fetchone()
    view: list[float | None] = [None] * 3 if entry.viewpoint is None else entry.viewpoint.tolist()
    if before is None:
        new_id = connection.execute("SELECT coalesce(max(id), 0) + 1 FROM plants").fetchone()[0]
        values = (new_id, entry.plant.name, *view, entry.plant.drift_rate, entry.plant.walk_rate)
        connection.execute("INSERT INTO plants VALUES (?, ?, ?, ?, ?, ?, ?)", values)
        return int(new_id), None
    _set_plant(connection, (*before[:2], *view, entry.plant.drift_rate, entry.plant.walk_rate))
    return int(before[0]), before


def _set_plant(connection: sqlite3.Connection, row: Row) -> None:
    """Write a row of ``plants`` over the one of its id."""
    names = "view_x=?, view_y=?, view_z=?, drift_rate=?, walk_rate=?"
    connection.execute(f"UPDATE plants SET {names} WHERE id=?", (*row[2:], row[0]))


def _changed(connection: sqlite3.Connection, plant: PlantMap, plant_id: int) -> dict[str, tuple[list[Row], list[Row]]]:
    """Rows that differ from what the map holds, and what it held for them (only an id: there was no row)."""
    known = {
        "clusters": connection.execute("SELECT * FROM clusters WHERE plant_id = ?", (plant_id,)).fetchall(),
        "flowers": connection.execute(
            "SELECT f.* FROM flowers f JOIN clusters c ON c.id = f.cluster_id WHERE c.plant_id = ?", (plant_id,)
        ).fetchall(),
    }
    new = {"clusters": cluster_rows(plant, plant_id), "flowers": flower_rows(plant)}
    out = {}
    for name, rows in new.items():
        old = {row[0]: row for row in known[name]}
        differing = [row for row in rows if old.get(row[0]) != row]
        out[name] = differing, [old.get(row[0], (row[0],)) for row in differing]
    return out


def upsert(connection: sqlite3.Connection, table: str, width: int, rows: list[Row]) -> None:
    """Write rows, over those of the same id."""
    names = [row[1] for row in connection.execute(f"PRAGMA table_info({table})")]
    changes = ", ".join(f"{name}=excluded.{name}" for name in names[1:])
    marks = ", ".join("?" * width)
    connection.executemany(f"INSERT INTO {table} VALUES ({marks}) ON CONFLICT(id) DO UPDATE SET {changes}", rows)


def _session(connection: sqlite3.Connection, entry: Entry, session_id: int, plant_id: int) -> None:
    s = entry.session
    values = (
        *(session_id, s.session, plant_id, entry.kind, entry.digest, _plain(s.start), _plain(s.end)),
        *tum_from_pose(entry.T_map_world).tolist(),
        *(entry.scale, json.dumps(entry.cov.ravel().tolist()), _plain(entry.evidence), entry.probability),
    )
    connection.execute(f"INSERT INTO sessions VALUES ({', '.join('?' * len(values))})", values)


def _observations(connection: sqlite3.Connection, entry: Entry, session_id: int) -> None:
    s = entry.session
    row = np.searchsorted(s.cluster_ids, s.flower_cluster_ids)
    counts = np.bincount(row, minlength=len(s.cluster_ids))
    centres = np.stack([np.bincount(row, x, len(counts)) for x in entry.flowers.T], axis=1) / counts[:, None]
    clusters = [
        (session_id, i, local, *place, int(n), p, int(new))
        for i, local, place, n, p, new in zip(
            *(entry.cluster_map_ids.tolist(), s.cluster_ids.tolist(), centres.round(6).tolist(), counts.tolist()),
            *(entry.cluster_probability.tolist(), entry.cluster_is_new.tolist()),
            strict=True,
        )
    ]
    clusters += [(session_id, i, None, None, None, None, 0, 1.0, 0) for i in entry.missed.tolist()]
    connection.executemany("INSERT INTO observations VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", clusters)
    flowers = [
        (session_id, i, local, *place, p, int(new))
        for i, local, place, p, new in zip(
            *(entry.flower_map_ids.tolist(), s.flower_ids.tolist(), entry.flowers.round(6).tolist()),
            *(entry.flower_probability.tolist(), entry.flower_is_new.tolist()),
            strict=True,
        )
    ]
    connection.executemany("INSERT INTO flower_observations VALUES (?, ?, ?, ?, ?, ?, ?, ?)", flowers)


def _count_up(connection: sqlite3.Connection, plant: PlantMap) -> None:
    for name, ids in (("clusters", plant.cluster_ids), ("flowers", plant.flower_ids)):
        first = int(ids.max(initial=-1)) + 1
        connection.execute("UPDATE counters SET next = max(next, ?) WHERE name = ?", (first, name))


def _prune(connection: sqlite3.Connection) -> None:
    """Forget how to undo sessions that are long past."""
    rows = connection.execute("SELECT session_id, length(before) FROM journal ORDER BY session_id DESC").fetchall()
    total = 0
    for k, (session_id, size) in enumerate(rows):
        total += size
        if k > 0 and (k >= JOURNAL_SESSIONS or total > JOURNAL_BYTES):
            connection.execute("DELETE FROM journal WHERE session_id <= ?", (session_id,))
            return


def undo(store: MapStore) -> StoredSession:
    """Take the latest session out again: all else is exactly as it was before it.

    Raises
    ------
    InputError
        There is no session, it is too long ago or damaged, or an event was recorded against a cluster that it brought.
    """
    with store.write() as connection:
        sessions = store.sessions()
        if not sessions:
            raise InputError(f"{store.path}: has no session to undo")
        last = sessions[-1]
        found = connection.execute("SELECT before FROM journal WHERE session_id = ?", (last.id,)).fetchone()
        if found is None:
            raise InputError(
                f"{store.path}: session {last.session!r} cannot be undone: "
                "it is too long ago, came by a merge, or was optimised since"
            )
        journal = _unpacked(store, last, found[0])
        _check_events(connection, store, last, [row[0] for row in journal["clusters"] if len(row) == 1])
        for table in ("journal", "observations", "flower_observations"):
            connection.execute(f"DELETE FROM {table} WHERE session_id = ?", (last.id,))
        connection.execute("DELETE FROM sessions WHERE id = ?", (last.id,))
        _restore(connection, "clusters", N_CLUSTER_COLUMNS, [r for r in journal["clusters"] if len(r) > 1])
        _restore(connection, "flowers", N_FLOWER_COLUMNS, [r for r in journal["flowers"] if len(r) > 1])
        for table in ("flowers", "clusters"):
            new = [(row[0],) for row in journal[table] if len(row) == 1]
            connection.executemany(f"DELETE FROM {table} WHERE id = ?", new)
        if journal["plant"] is None:
            connection.execute("DELETE FROM plants WHERE name = ?", (last.plant,))
        else:
            _set_plant(connection, tuple(journal["plant"]))
    return last


def _unpacked(store: MapStore, session: StoredSession, before: bytes) -> dict[str, Any]:
    try:
        return unpacked(before)
    except ValueError:
        text = f"is damaged (what session {session.session!r} changed cannot be read); nothing has changed"
        raise InputError(f"{store.path}: {text}, `cluster-slam map check` says more") from None


def _restore(connection: sqlite3.Connection, table: str, width: int, rows: list[list[object]]) -> None:
    upsert(connection, table, width, [tuple(row) for row in rows])


def _check_events(connection: sqlite3.Connection, store: MapStore, last: StoredSession, new: list[int]) -> None:
    for cluster in new:
        n = connection.execute("SELECT count(*) FROM events WHERE cluster_id = ?", (cluster,)).fetchone()[0]
        if n:
            text = f"session {last.session!r} brought cluster {cluster}, against which {n} events are recorded"
            raise InputError(f"{store.path}: {text}: delete them first (`map event --delete`), expected none")


def _plain(value: float) -> float | None:
    return None if value != value else value
