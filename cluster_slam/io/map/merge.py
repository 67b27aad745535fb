"""The plants of one map taken into another, with new ids and all that hangs on them."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping

from cluster_slam.errors import InputError
from cluster_slam.io.map.rows import Row
from cluster_slam.io.map.store import MapStore


def merge_map(
    store: MapStore, source: MapStore, prefix: str = "", names: Mapping[str, str] | None = None
) -> tuple[list[str], int]:
    """Copy all plants of ``source``; what they are called now, and the number of their clusters.

    Parameters
    ----------
    prefix
        Put before the names of its plants.
    names
        Other names for some of its plants; the prefix is not put before them.

    Raises
    ------
    InputError
        A plant's name or a session is in both maps, a plant to be renamed is not there, or they are one file.
    OutputError
        The map cannot be written: nothing has changed.
    """
    if store.path.resolve() == source.path.resolve():
        raise InputError(f"{source.path}: is the map itself, expected another one")
    called = _called(source, prefix, names or {})
    with store.write() as connection:
        _check_names(store, source, called)
        plants = _copy_plants(connection, source, called)
        sessions = _copy(connection, source, "sessions", 0, {2: plants})
        clusters = _copy(connection, source, "clusters", _next(connection, "clusters"), {1: plants})
        flowers = _copy(connection, source, "flowers", _next(connection, "flowers"), {1: clusters})
        _copy_rows(connection, source, "observations", {0: sessions, 1: clusters})
        _copy_rows(connection, source, "flower_observations", {0: sessions, 1: flowers})
        _copy(connection, source, "events", 0, {1: clusters})
        for name, ids in (("clusters", clusters), ("flowers", flowers)):
            first = max(ids.values(), default=-1) + 1
            connection.execute("UPDATE counters SET next = max(next, ?) WHERE name = ?", (first, name))
    return list(called.values()), len(clusters)


def _called(source: MapStore, prefix: str, names: Mapping[str, str]) -> dict[str, str]:
    """New name of each plant of the other map."""
    known = source.plant_names()
    for old in names:
        if old not in known:
            raise InputError(f"{source.path}: no plant {old!r} to rename, it has: {', '.join(known) or 'none'}")
    return {name: names.get(name, prefix + name) for name in known}


def _check_names(store: MapStore, source: MapStore, called: Mapping[str, str]) -> None:
    taken = set(store.plant_names())
    known = {s.session for s in store.sessions()}
    for session in source.sessions():
        if session.session in known:
            text = f"{source.path}: session {session.session!r} of plant {session.plant!r} is in both maps"
            raise InputError(f"{text}, expected each once; nothing has changed")
    for name, new in called.items():
        if new in taken:
            text = f"{source.path}: plant {new!r} is in both maps, each in a frame of its own; another plant: "
            raise InputError(f"{text}--rename {name}=NEW or --prefix; the same: `map add` its sessions' results")
        taken.add(new)


def _next(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute("SELECT next FROM counters WHERE name = ?", (name,)).fetchone()[0])


def _copy_plants(connection: sqlite3.Connection, source: MapStore, called: Mapping[str, str]) -> dict[int, int]:
    first = connection.execute("SELECT coalesce(max(id), 0) + 1 FROM plants").fetchone()[0]
    rows = source.read("SELECT * FROM plants ORDER BY id")
    ids = {row[0]: first + k for k, row in enumerate(rows)}
    _insert(connection, "plants", [(ids[row[0]], called[row[1]], *row[2:]) for row in rows])
    return ids


def _copy(
    connection: sqlite3.Connection, source: MapStore, table: str, first: int, columns: dict[int, dict[int, int]]
) -> dict[int, int]:
    """Rows with new ids from ``first`` on (0: after the largest), and columns that refer to others; the new ids."""
    start = first or connection.execute(f"SELECT coalesce(max(id), -1) + 1 FROM {table}").fetchone()[0]
    rows = source.read(f"SELECT * FROM {table} ORDER BY id")
    ids = {row[0]: start + k for k, row in enumerate(rows)}
    _insert(connection, table, [_renamed(row, {0: ids, **columns}) for row in rows])
    return ids


def _copy_rows(
    connection: sqlite3.Connection, source: MapStore, table: str, columns: dict[int, dict[int, int]]
) -> None:
    rows = source.read(f"SELECT * FROM {table} ORDER BY rowid")
    _insert(connection, table, [_renamed(row, columns) for row in rows])


def _renamed(row: Row, columns: dict[int, dict[int, int]]) -> Row:
    return tuple(columns[k][value] if k in columns else value for k, value in enumerate(row))


def _insert(connection: sqlite3.Connection, table: str, rows: list[Row]) -> None:
    if rows:
        connection.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(rows[0]))})", rows)
