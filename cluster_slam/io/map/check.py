"""Is a map whole? What SQLite says, what refers to what, and whether all numbers are possible."""

from __future__ import annotations

import sqlite3

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.io.map.journal import unpacked
from cluster_slam.io.map.store import MapStore

_ORPHANS = (
    ("flowers of no cluster", "SELECT count(*) FROM flowers WHERE cluster_id NOT IN (SELECT id FROM clusters)"),
    ("clusters of no plant", "SELECT count(*) FROM clusters WHERE plant_id NOT IN (SELECT id FROM plants)"),
    ("sessions of no plant", "SELECT count(*) FROM sessions WHERE plant_id NOT IN (SELECT id FROM plants)"),
    ("plants of no session", "SELECT count(*) FROM plants WHERE id NOT IN (SELECT plant_id FROM sessions)"),
    (
        "observations of no session",
        "SELECT count(*) FROM observations WHERE session_id NOT IN (SELECT id FROM sessions)",
    ),
    (
        "observations of no cluster",
        "SELECT count(*) FROM observations WHERE cluster_id NOT IN (SELECT id FROM clusters)",
    ),
    (
        "flower observations of no session",
        "SELECT count(*) FROM flower_observations WHERE session_id NOT IN (SELECT id FROM sessions)",
    ),
    (
        "flower observations of no flower",
        "SELECT count(*) FROM flower_observations WHERE flower_id NOT IN (SELECT id FROM flowers)",
    ),
    ("events of no cluster", "SELECT count(*) FROM events WHERE cluster_id NOT IN (SELECT id FROM clusters)"),
    (
        "sessions without observations",
        "SELECT count(*) FROM sessions WHERE id NOT IN (SELECT session_id FROM observations)",
    ),
    (
        "one flower twice in a session",
        "SELECT count(*) FROM (SELECT 1 FROM flower_observations GROUP BY session_id, flower_id HAVING count(*) > 1)",
    ),
    (
        "one cluster twice in a session",
        "SELECT count(*) FROM (SELECT 1 FROM observations GROUP BY session_id, cluster_id HAVING count(*) > 1)",
    ),
    (
        "clusters beyond the counter",
        "SELECT count(*) FROM clusters WHERE id >= (SELECT next FROM counters WHERE name='clusters')",
    ),
    (
        "flowers beyond the counter",
        "SELECT count(*) FROM flowers WHERE id >= (SELECT next FROM counters WHERE name='flowers')",
    ),
)


def problems(store: MapStore) -> list[str]:
    """What is wrong with a map, one line each; none where it is whole."""
    found: list[str] = []
    try:
        found += [row[0] for row in store.connection.execute("PRAGMA integrity_check") if row[0] != "ok"]
        if found:
            return found
        found += [f"{row[0]}: a row refers to nothing" for row in store.connection.execute("PRAGMA foreign_key_check")]
        for what, query in _ORPHANS:
            n = store.connection.execute(query).fetchone()[0]
            found += [f"{n} {what}"] if n else []
        found += _sessions(store)
        found += _journals(store)
        for name in store.plant_names():
            found += _numbers(store, name)
    except (sqlite3.Error, InputError) as error:
        found.append(str(error))
    except (ValueError, TypeError, LookupError) as error:
        found.append(f"a value cannot be read ({error})")
    return found


def _sessions(store: MapStore) -> list[str]:
    found = []
    for session in store.sessions():
        if not (np.isfinite(session.T_map_world).all() and np.isfinite(session.cov).all() and session.scale > 0):
            found.append(f"session {session.session}: its alignment is not finite")
        elif np.linalg.eigvalsh(session.cov)[0] < -1e-12:
            found.append(f"session {session.session}: its alignment's covariance is not positive definite")
    return found


def _journals(store: MapStore) -> list[str]:
    found = []
    for session, before in store.connection.execute("SELECT session_id, before FROM journal"):
        try:
            unpacked(before)
        except ValueError:
            found.append(f"session {session} cannot be undone: its journal is damaged")
    return found


def _numbers(store: MapStore, name: str) -> list[str]:
    plant = store.plant(name)
    found = []
    for what, covs in (("cluster", plant.cluster_covs), ("flower", plant.flower_covs)):
        if len(covs) and not (np.isfinite(covs).all() and (np.linalg.eigvalsh(covs)[:, 0] > -1e-15).all()):
            found.append(f"plant {name}: a {what}'s covariance is not positive definite")
    for what, values in (("cluster", plant.cluster_presence), ("flower", plant.flower_presence)):
        if not ((values >= 0) & (values <= 1)).all():
            found.append(f"plant {name}: a {what}'s presence is outside 0 to 1")
    if not (np.isfinite(plant.clusters).all() and np.isfinite(plant.flowers).all()):
        found.append(f"plant {name}: a position is not finite")
    return found
