"""The living flowers, as arrays that grow."""

from __future__ import annotations

from typing import Any

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_FIELDS: dict[str, tuple[tuple[int, ...], type]] = {
    "ids": ((), np.int64),
    "slot": ((), np.int64),  # row of its cluster in the list of clusters
    "place": ((3,), np.float64),  # at rest, world, m
    "cov": ((3, 3), np.float64),
    "lever": ((3, 6), np.float64),  # how its place follows the hand-eye tangent: mean of the observations' Jacobians
    "n": ((), np.int64),  # observations
    "first": ((), np.float64),  # s
    "last": ((), np.float64),  # s
    "hits": ((), np.int64),  # bits: seen in the last looks, the newest lowest
    "vain": ((), np.int64),  # looks in vain since it was last seen
    "looks": ((), np.float64),  # frames that looked at it, old ones forgotten
    "found": ((), np.float64),  # of those, how many saw it
    "confirmed": ((), np.bool_),
    "told": ((), np.bool_),  # its id has been given out
    "kind": ((), np.int64),  # of place where it was born
    "seat": ((), np.int64),  # of a confirmed flower in the grouping's sums, -1 of a tentative one
}


class FlowerTable:
    """One row a flower, tentative or confirmed; rows are removed and appended, ids are never used twice."""

    ids: IntArray
    slot: IntArray
    place: Array
    cov: Array
    lever: Array
    n: IntArray
    first: Array
    last: Array
    hits: IntArray
    vain: IntArray
    looks: Array
    found: Array
    confirmed: BoolArray
    told: BoolArray
    kind: IntArray
    seat: IntArray

    def __init__(self) -> None:
        self.next_id = 0
        for name, (shape, kind) in _FIELDS.items():
            setattr(self, name, np.zeros((0, *shape), dtype=kind))

    def __len__(self) -> int:
        return len(self.ids)

    def keep(self, alive: BoolArray) -> None:
        """Remove the rows that are not alive."""
        for name in _FIELDS:
            setattr(self, name, getattr(self, name)[alive])

    def add(self, place: Array, cov: Array, lever: Array, slot: IntArray, stamp: float) -> IntArray:
        """New tentative flowers (q,), seen once; returns their rows."""
        q, before = len(place), len(self)
        new: dict[str, Any] = {k: np.zeros((q, *shape), dtype=kind) for k, (shape, kind) in _FIELDS.items()}
        new["ids"] = self.next_id + np.arange(q)
        new |= {"place": place, "cov": cov, "lever": lever, "slot": slot}
        new["n"][:] = new["hits"][:] = 1
        new["looks"][:] = new["found"][:] = 1.0
        new["seat"][:] = -1
        new["first"][:] = new["last"][:] = stamp
        self.next_id += q
        for name in _FIELDS:
            setattr(self, name, np.concatenate([getattr(self, name), new[name]]))
        return before + np.arange(q)

    def state(self) -> dict[str, Array]:
        """All arrays by name, to be written down."""
        return {name: getattr(self, name) for name in _FIELDS} | {"next_id": np.array(self.next_id, dtype=float)}

    def restore(self, state: dict[str, Array]) -> None:
        """Take over what ``state`` gave."""
        for name, (_, kind) in _FIELDS.items():
            setattr(self, name, np.asarray(state[name], dtype=kind))
        self.next_id = int(state["next_id"])
