"""The tables of a map, their version, and how older ones are brought up to date."""

from __future__ import annotations

import sqlite3

APPLICATION_ID = 0x434C5331  # "CLS1": tells a map from any other SQLite file
VERSION = 1

POINT = "x REAL NOT NULL, y REAL NOT NULL, z REAL NOT NULL"
_UPPER = ("xx", "xy", "xz", "yy", "yz", "zz")


def covariance(prefix: str) -> str:
    """Columns of the upper triangle of a 3 x 3 matrix."""
    return ", ".join(f"{prefix}_{part} REAL NOT NULL" for part in _UPPER)


TABLES = f"""
CREATE TABLE plants (
  id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE,
  view_x REAL, view_y REAL, view_z REAL,  -- mean camera position, map
  drift_rate REAL NOT NULL,               -- m/day, RMS norm
  walk_rate REAL NOT NULL                 -- m/sqrt(day), one sigma an axis
);
CREATE TABLE sessions (
  id INTEGER PRIMARY KEY, session TEXT NOT NULL UNIQUE, plant_id INTEGER NOT NULL REFERENCES plants(id),
  kind TEXT NOT NULL,                     -- result or landmarks
  digest TEXT NOT NULL,                   -- SHA-256 of what came in
  start REAL, end REAL,                   -- s
  tx REAL NOT NULL, ty REAL NOT NULL, tz REAL NOT NULL,
  qx REAL NOT NULL, qy REAL NOT NULL, qz REAL NOT NULL, qw REAL NOT NULL,  -- T_map_world
  scale REAL NOT NULL,                    -- p_map = T_map_world * (scale * p_world)
  cov TEXT NOT NULL,                      -- 6 x 6 of [rx ry rz tx ty tz], right, as JSON
  evidence REAL, probability REAL NOT NULL
);
CREATE TABLE clusters (
  id INTEGER PRIMARY KEY, plant_id INTEGER NOT NULL REFERENCES plants(id),
  {POINT}, {covariance("cov")}, time REAL,
  vx REAL NOT NULL, vy REAL NOT NULL, vz REAL NOT NULL, {covariance("vcov")}, {covariance("pvcov")},
  growth_rate REAL NOT NULL, growth_var REAL NOT NULL,
  n_flowers INTEGER NOT NULL, inertia REAL NOT NULL, mean_distance REAL NOT NULL,
  cov_ii REAL NOT NULL, cov_id REAL NOT NULL, cov_dd REAL NOT NULL,
  first_seen REAL, last_seen REAL, last_looked_at REAL, presence REAL NOT NULL
);
CREATE TABLE flowers (
  id INTEGER PRIMARY KEY, cluster_id INTEGER NOT NULL REFERENCES clusters(id),
  {POINT}, {covariance("cov")},
  first_seen REAL, last_seen REAL, last_looked_at REAL, presence REAL NOT NULL
);
CREATE TABLE observations (               -- of a persistent cluster by a session
  session_id INTEGER NOT NULL REFERENCES sessions(id), cluster_id INTEGER NOT NULL REFERENCES clusters(id),
  local_id INTEGER,                       -- the session's own; NULL where it looked and saw nothing
  x REAL, y REAL, z REAL,                 -- centroid in map
  n_flowers INTEGER NOT NULL, probability REAL NOT NULL, is_new INTEGER NOT NULL
);
CREATE TABLE flower_observations (
  session_id INTEGER NOT NULL REFERENCES sessions(id), flower_id INTEGER NOT NULL REFERENCES flowers(id),
  local_id INTEGER, x REAL, y REAL, z REAL, probability REAL NOT NULL, is_new INTEGER NOT NULL
);
CREATE TABLE events (
  id INTEGER PRIMARY KEY, cluster_id INTEGER NOT NULL REFERENCES clusters(id),
  kind TEXT NOT NULL, time REAL NOT NULL, note TEXT NOT NULL
);
CREATE TABLE journal (                    -- what undo needs: rows as they were before a session
  session_id INTEGER PRIMARY KEY REFERENCES sessions(id), before BLOB NOT NULL
);
CREATE TABLE counters (name TEXT PRIMARY KEY, next INTEGER NOT NULL);  -- ids are never used twice
INSERT INTO counters VALUES ('clusters', 0), ('flowers', 0);
CREATE INDEX clusters_of_plant ON clusters(plant_id);
CREATE INDEX flowers_of_cluster ON flowers(cluster_id);
CREATE INDEX observations_of_session ON observations(session_id);
CREATE INDEX flower_observations_of_session ON flower_observations(session_id);
CREATE INDEX events_of_cluster ON events(cluster_id);
"""

MIGRATIONS: dict[int, str] = {}  # from version n to n + 1


def create(connection: sqlite3.Connection) -> None:
    """Make the tables of the newest version in an empty file, in one transaction."""
    script = f"BEGIN IMMEDIATE; {TABLES} PRAGMA application_id={APPLICATION_ID}; PRAGMA user_version={VERSION}; COMMIT;"
    connection.executescript(script)


def migrate(connection: sqlite3.Connection, version: int) -> None:
    """Bring older tables up to date, each step in a transaction of its own."""
    for step in range(version, VERSION):
        connection.executescript(f"BEGIN IMMEDIATE; {MIGRATIONS[step]} PRAGMA user_version={step + 1}; COMMIT;")
