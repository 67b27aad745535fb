"""A map opened: plants as records, sessions, and transactions that leave it as it was or complete."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from cluster_slam.errors import InputError, OutputError
from cluster_slam.geometry import Array, pose_from_tum
from cluster_slam.io.map import schema
from cluster_slam.io.map.header import check_file
from cluster_slam.io.map.rows import Row, plant_from_rows, sightings_from_rows
from cluster_slam.records import PlantMap, Sightings

BUSY_S = 5.0  # so long a writer waits for another


@dataclass(frozen=True, slots=True, eq=False)
class StoredSession:
    """A session as the map keeps it."""

    id: int
    session: str
    plant: str
    kind: str  # result or landmarks
    digest: str
    start: float  # s, NaN where unknown
    end: float
    T_map_world: Array  # (4, 4)
    scale: float
    cov: Array  # (6, 6)
    evidence: float
    probability: float


class MapStore:
    """An open map. Use it as a context manager; ``write`` gives a transaction."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self.connection = connection

    def __enter__(self) -> MapStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self.connection.close()

    @contextmanager
    def write(self) -> Iterator[sqlite3.Connection]:
        """A transaction: all of it or nothing, even if the program is killed.

        Raises
        ------
        OutputError
            Another program is writing, the disk is full, or the file cannot be written: nothing has changed.
        """
        try:
            self.connection.execute("BEGIN IMMEDIATE")
            yield self.connection
            self.connection.execute("COMMIT")
        except sqlite3.Error as error:
            self._rollback()
            raise refused(self.path, error) from None
        except BaseException:
            self._rollback()
            raise

    def _rollback(self) -> None:
        if self.connection.in_transaction:
            self.connection.execute("ROLLBACK")

    def plant_names(self) -> list[str]:
        """Names of all plants, in the order in which they came."""
        return [name for (name,) in self.read("SELECT name FROM plants ORDER BY id")]

    def plant(self, name: str, *, with_sightings: bool = True) -> PlantMap:
        """One plant by its name; sightings are of use to predictions alone.

        Raises
        ------
        InputError
            There is none of this name.
        """
        found = self.read(
            "SELECT id, name, view_x, view_y, view_z, drift_rate, walk_rate FROM plants WHERE name = ?", (name,)
        )
        if not found:
            known = ", ".join(self.plant_names()[:10]) or "none"
            raise InputError(f"{self.path}: no plant {name!r}, it has: {known}")
        plant_id = found[0][0]
        clusters = self.read("SELECT * FROM clusters WHERE plant_id = ? ORDER BY id", (plant_id,))
        flowers = self.read(
            "SELECT f.* FROM flowers f JOIN clusters c ON c.id = f.cluster_id WHERE c.plant_id = ? ORDER BY f.id",
            (plant_id,),
        )
        last = self.read("SELECT max(end) FROM sessions WHERE plant_id = ?", (plant_id,))[0][0]
        sightings = self._sightings(plant_id) if with_sightings else None
        return plant_from_rows(found[0], clusters, flowers, last, sightings)

    def _sightings(self, plant_id: int) -> Sightings:
        """Which session saw which flowers of a plant."""
        sessions = self.read(
            "SELECT id, coalesce(start, end) FROM sessions WHERE plant_id = ? ORDER BY id", (plant_id,)
        )
        seen = self.read(
            "SELECT o.flower_id, o.session_id FROM sessions s JOIN flower_observations o ON o.session_id = s.id "
            "WHERE s.plant_id = ? AND o.local_id IS NOT NULL ORDER BY o.session_id, o.flower_id",
            (plant_id,),
        )
        return sightings_from_rows(sessions, seen)

    def plants(self, *, with_sightings: bool = True) -> list[PlantMap]:
        """All plants, in the order in which they came."""
        return [self.plant(name, with_sightings=with_sightings) for name in self.plant_names()]

    def sessions(self, plant: str | None = None) -> list[StoredSession]:
        """All sessions, of one plant or all, in the order in which they were added."""
        rows = self.read(
            "SELECT s.id, s.session, p.name, s.kind, s.digest, s.start, s.end, s.tx, s.ty, s.tz, s.qx, s.qy, s.qz, "
            "s.qw, s.scale, s.cov, s.evidence, s.probability FROM sessions s JOIN plants p ON p.id = s.plant_id "
            "WHERE ? IS NULL OR p.name = ? ORDER BY s.id",
            (plant, plant),
        )
        return [_session(row) for row in rows]

    def read(self, query: str, values: tuple[object, ...] = ()) -> list[Row]:
        """Rows of a query; what goes wrong is told as a damaged map.

        Raises
        ------
        InputError
            The file is damaged.
        """
        try:
            return self.connection.execute(query, values).fetchall()
        except sqlite3.Error as error:
            raise InputError(
                f"{self.path}: cannot be read ({error}), expected a map; see `cluster-slam map check`"
            ) from None


def _session(row: Row) -> StoredSession:
    T = pose_from_tum(np.array(row[7:14], dtype=float))
    start, end, evidence = (float("nan") if v is None else float(v) for v in (row[5], row[6], row[16]))
    cov = np.array(json.loads(row[15]), dtype=float).reshape(6, 6)
    name = (row[0], row[1], row[2], row[3], row[4])
    return StoredSession(*name, start, end, T, row[14], cov, evidence, row[17])


def create_map(path: str | Path) -> MapStore:
    """Make an empty map.

    Raises
    ------
    OutputError
        The name is taken, or the file cannot be written.
    """
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise OutputError(f"{path}: exists already, expected a free name for a new map")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: {path.parent} is no folder, expected one that is there")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        connection = sqlite3.connect(temporary, isolation_level=None)
        try:
            schema.create(connection)
            connection.execute("PRAGMA journal_mode=WAL")
        finally:
            connection.close()
        os.link(temporary, path)
    except FileExistsError:
        raise OutputError(f"{path}: exists already, expected a free name for a new map") from None
    except (sqlite3.Error, OSError) as error:
        raise OutputError(f"{path}: cannot be written ({error}), expected a place with room for a map") from None
    finally:
        for left in (temporary, Path(f"{temporary}-wal"), Path(f"{temporary}-shm")):
            left.unlink(missing_ok=True)
    return open_map(path)


def open_map(path: str | Path) -> MapStore:
    """Open a map; an older schema is brought up to date.

    Raises
    ------
    InputError
        Missing, no map, damaged, or of a newer schema than this program knows.
    """
    path = Path(path)
    check_file(path)
    try:
        connection = sqlite3.connect(path, isolation_level=None, timeout=BUSY_S)
        _prepare(path, connection)
    except sqlite3.Error as error:
        raise refused(path, error) from None
    except UnicodeDecodeError:  # of what SQLite says itself
        raise InputError(f"{path}: is damaged (a name in it is no text), expected a map") from None
    return MapStore(path, connection)


def _prepare(path: Path, connection: sqlite3.Connection) -> None:
    try:
        application = connection.execute("PRAGMA application_id").fetchone()[0]
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if application != schema.APPLICATION_ID:
            raise InputError(f"{path}: is an SQLite file but no map, expected one that `cluster-slam map create` made")
        if version > schema.VERSION:
            raise InputError(
                f"{path}: has schema version {version}, this program knows {schema.VERSION}: update cluster-slam"
            )
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute("PRAGMA synchronous=FULL")
        if version < schema.VERSION:
            schema.migrate(connection, version)
    except BaseException:
        connection.close()
        raise


def refused(path: Path, error: sqlite3.Error) -> OutputError | InputError:
    """What an error of SQLite means to a person."""
    text = str(error)
    if "locked" in text or "busy" in text:
        return OutputError(f"{path}: another program is writing to it; nothing has changed, try again when it is done")
    if "full" in text:
        return OutputError(f"{path}: the disk is full; nothing has changed, make room and try again")
    if "I/O" in text:  # also what SQLite says where no room is left for the index of its journal
        return OutputError(f"{path}: cannot be written ({text}); nothing has changed, is the disk full?")
    if "readonly" in text or "unable to open" in text:
        return OutputError(f"{path}: cannot be written ({text}); nothing has changed")
    if "UNIQUE" in text:
        return InputError(f"{path}: {text}; nothing has changed")
    return InputError(f"{path}: is damaged ({text}); nothing has changed, `cluster-slam map check` says more")
