"""When a plant's sessions looked at its flowers, and which of them they saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.constellation.growth import DAY_S
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray, PlantMap
from tracking.presence import persisted


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """Looks at the flowers (f,) and clusters (c,) of a plant by its sessions (s,)."""

    seen: BoolArray  # (f, s)
    beside: BoolArray  # (f, s) another flower of its cluster was seen: had it been there and in sight, it would be, too
    counts: IntArray  # (c, s) flowers of the cluster that were seen ...
    newcomers: IntArray  # (c, s) ... for the first time
    days: Array  # (s,) from the first session on; that a session has no date counts as no time

    @property
    def first(self) -> IntArray:
        """First session (f,) that saw each flower."""
        found: IntArray = np.argmax(self.seen, axis=1)
        return found

    @property
    def last(self) -> IntArray:
        """Last session (f,) that saw each flower."""
        found: IntArray = self.seen.shape[1] - 1 - np.argmax(self.seen[:, ::-1], axis=1)
        return found


def history_of(plant: PlantMap) -> History:
    """The looks that a plant's sightings tell; without them, flowers count as seen from the first time to the last."""
    row = plant.flower_rows
    seen, times = _seen(plant)
    counts = np.zeros((len(plant.cluster_ids), len(times)), dtype=np.int64)
    np.add.at(counts, row, seen)
    newcomers = np.zeros_like(counts)
    np.add.at(newcomers, (row, np.argmax(seen, axis=1)), seen.any(axis=1))
    begin = np.min(times[np.isfinite(times)], initial=np.inf)
    days: Array = np.maximum.accumulate(np.where(np.isfinite(times), (times - begin) / DAY_S, 0.0))
    return History(seen, counts[row] > seen, counts, newcomers, days)


def _seen(plant: PlantMap) -> tuple[BoolArray, Array]:
    """Which flowers (f, s) each session saw, and the sessions' times (s,)."""
    told = plant.sightings
    if told is None:
        times = np.unique(np.concatenate([plant.flower_first_seen, plant.flower_last_seen]))
        within: BoolArray = (times >= plant.flower_first_seen[:, None]) & (times <= plant.flower_last_seen[:, None])
        return within, times
    known = np.isin(told.flower_ids, plant.flower_ids)
    seen = np.zeros((len(plant.flower_ids), len(told.session_times)), dtype=bool)
    seen[np.searchsorted(plant.flower_ids, told.flower_ids[known]), told.sessions[known]] = True
    return seen, told.session_times


def hidden_looks(history: History, real: Array, share: float, loss_rate: float) -> Array:
    """How often (f,) each flower was hidden since it was last seen: it may be lost by now, or was false from the start.

    Expectations given all looks in vain: of a flower that is there each one sees a ``share``, and each day one in
    1 / ``loss_rate`` is lost.
    """
    last, sessions = history.last, np.arange(len(history.days))
    vain = history.beside & (sessions > last[:, None])
    there, gone = real.copy(), 1.0 - real  # probabilities together with the looks so far
    hidden, when_gone = np.zeros(len(last)), np.zeros(len(last))
    day = history.days[last]
    for s in np.flatnonzero(vain.any(axis=0)).tolist():
        is_vain = vain[:, s]
        lost = np.where(is_vain, there * (1.0 - persisted(np.ones(1), loss_rate, history.days[s] - day)), 0.0)
        gone, when_gone = gone + lost, when_gone + lost * hidden
        there = np.where(is_vain, (there - lost) * (1.0 - share), there)
        hidden, day = hidden + is_vain, np.where(is_vain, history.days[s], day)
    expected: Array = (when_gone + there * hidden) / (there + gone)
    return expected
