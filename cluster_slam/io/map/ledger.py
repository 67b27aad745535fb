"""The ledger: what was done to which cluster, and which clusters answer a question."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cluster_slam.errors import InputError
from cluster_slam.io.map.store import MapStore
from cluster_slam.io.map.times import seconds
from cluster_slam.io.text import shown
from cluster_slam.records import PlantMap

_OPERATORS: dict[str, Callable[[Any, Any], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "!=": operator.ne,
    "==": operator.eq,
    "=": operator.eq,
    ">": operator.gt,
    "<": operator.lt,
}
_COMPARISON = re.compile(r"(\w+)\s*(>=|<=|!=|==|=|>|<)\s*(\S.*)")
_EVENT = re.compile(r"(not\s+)?(\w+)(?:\s+since\s+(\S.*))?")


@dataclass(frozen=True, slots=True)
class Event:
    """Something that was done to a cluster, or a note."""

    id: int
    cluster: int
    kind: str
    time: float  # s
    note: str


@dataclass(frozen=True, slots=True)
class ClusterRow:
    """A cluster as lists show it."""

    map_id: int
    plant: str
    x: float
    y: float
    z: float
    n_flowers: int  # that are still there, as far as is known
    presence: float
    state: str  # present, gone or unknown
    last_seen: float
    last_looked_at: float


def state_of(presence: float, present_above: float = 0.5, gone_below: float = 0.1) -> str:
    """A presence in a word."""
    if presence > present_above:
        return "present"
    return "gone" if presence < gone_below else "unknown"


def cluster_list(plant: PlantMap) -> list[ClusterRow]:
    """All clusters of a plant."""
    times = zip(plant.cluster_last_seen.tolist(), plant.cluster_last_looked_at.tolist(), strict=True)
    return [
        ClusterRow(i, plant.name, place[0], place[1], place[2], n, p, state_of(p), seen, looked)
        for i, place, n, p, (seen, looked) in zip(
            *(plant.cluster_ids.tolist(), plant.clusters.tolist(), plant.n_flowers.tolist()),
            *(plant.cluster_presence.tolist(), times),
            strict=True,
        )
    ]


def record(store: MapStore, cluster: int, kind: str, time: float, note: str) -> Event:
    """Record an event against a cluster.

    Raises
    ------
    InputError
        The map has no such cluster, or the kind is no word.
    """
    if not re.fullmatch(r"\w+", kind) or kind in ("not", "since", "and"):
        raise InputError(f"kind {shown(kind)}, expected one word as pollinated, harvested or note")
    with store.write() as connection:
        if not connection.execute("SELECT 1 FROM clusters WHERE id = ?", (cluster,)).fetchone():
            raise InputError(f"{store.path}: no cluster {cluster}; `cluster-slam map list {store.path}` shows them")
        values = (cluster, kind, time, note)
        done = connection.execute("INSERT INTO events (cluster_id, kind, time, note) VALUES (?, ?, ?, ?)", values)
        return Event(int(done.lastrowid or 0), *values)


def delete_event(store: MapStore, event: int) -> None:
    """Take an event out of the ledger.

    Raises
    ------
    InputError
        There is no such event.
    """
    with store.write() as connection:
        if not connection.execute("DELETE FROM events WHERE id = ?", (event,)).rowcount:
            raise InputError(f"{store.path}: no event {event}")


def events(store: MapStore, cluster: int | None = None) -> list[Event]:
    """Events of one cluster or of all, oldest first."""
    rows = store.read(
        "SELECT id, cluster_id, kind, time, note FROM events WHERE ? IS NULL OR cluster_id = ? ORDER BY time, id",
        (cluster, cluster),
    )
    return [Event(*row) for row in rows]


def ask(store: MapStore, where: str | None) -> list[ClusterRow]:
    """The clusters for which all conditions hold.

    ``where`` joins conditions with ``and``: comparisons of a column of :class:`ClusterRow` (``n_flowers >= 3``,
    ``plant = row3``, ``last_seen < 2026-05-04``), and events (``pollinated``, ``pollinated since 2026-05-04``,
    ``not pollinated since monday``).

    Raises
    ------
    InputError
        A condition cannot be read; the message says what can.
    """
    parts = re.split(r"\s+and\s+", where.strip()) if where else []
    known: dict[int, list[Event]] = {}
    for event in events(store):
        known.setdefault(event.cluster, []).append(event)
    conditions = [_condition(part, known) for part in parts]
    rows = [row for plant in store.plants() for row in cluster_list(plant)]
    return [row for row in rows if all(condition(row) for condition in conditions)]


def _condition(text: str, known: dict[int, list[Event]]) -> Callable[[ClusterRow], bool]:
    compared = _COMPARISON.fullmatch(text.strip())
    if compared:
        return _comparison(*compared.groups())
    event = _EVENT.fullmatch(text.strip())
    if not event:
        raise InputError(f"condition {shown(text)}, expected as in 'n_flowers >= 3 and not pollinated since monday'")
    negated, kind, since = event.groups()
    begin = seconds(since) if since else float("-inf")

    def happened(row: ClusterRow) -> bool:
        found = any(e.kind == kind and e.time >= begin for e in known.get(row.map_id, []))
        return found != bool(negated)

    return happened


def _comparison(column: str, sign: str, value: str) -> Callable[[ClusterRow], bool]:
    if column not in ClusterRow.__dataclass_fields__:
        names = ", ".join(ClusterRow.__dataclass_fields__)
        raise InputError(f"condition on {shown(column)}, expected one of: {names}")
    compare = _OPERATORS[sign]
    if column in ("plant", "state"):
        wanted = value.strip("'\"")
        return lambda row: compare(getattr(row, column), wanted)
    if column in ("last_seen", "last_looked_at"):
        number = seconds(value)
    else:
        try:
            number = float(value)
        except ValueError:
            raise InputError(f"condition {column} {sign} {shown(value)}, expected a number") from None
    return lambda row: compare(getattr(row, column), number)
