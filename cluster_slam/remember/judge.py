"""A map held against the truth of its sessions: who was known again rightly, and were the probabilities true?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.map.incoming import names_of
from cluster_slam.io.map.store import MapStore, StoredSession
from cluster_slam.io.run_record import read_run
from cluster_slam.io.tables import read_table
from cluster_slam.records import CLUTTER, BoolArray, IntArray
from cluster_slam.remember.score import Confusion, confusion

EDGES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)  # of what is said


@dataclass(frozen=True, slots=True)
class Bin:
    """Decisions that were said to be about as sure."""

    said: float  # mean probability
    right: float  # share that was right
    n: int


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a map's clusters (or flowers), over all sessions but each plant's first."""

    confusion: Confusion
    matches: list[Bin]  # "the same"
    new: list[Bin]  # "nobody the map knows"


def judge(store: MapStore, results: Sequence[Path]) -> tuple[Verdict, Verdict]:
    """Clusters and flowers of a map against the truth of the sessions that were put into it.

    Parameters
    ----------
    results
        The result folders that were added, of sessions with ``truth/``.

    Raises
    ------
    InputError
        A session of the map is missing among the results, or has no truth.
    """
    truth = dict(_true_ids(folder) for folder in results)
    for session in store.sessions():
        if session.session not in truth:
            text = f"{store.path}: session {session.session!r} is not among the results with truth"
            raise InputError(f"{text}, expected all {len(store.sessions())} sessions of the map")
    return _verdict(store, truth, 0), _verdict(store, truth, 1)


def _true_ids(folder: Path) -> tuple[str, tuple[dict[int, int], dict[int, int]]]:
    """Session of a result, and the true id of each of its clusters and flowers: that of most of its observations."""
    run = read_run(folder / "run.json")
    if run.session_path is None or not (run.session_path / "truth" / "observations.csv").exists():
        raise InputError(f"{folder}: its session has no truth/observations.csv, expected one to judge by")
    path = run.session_path / "truth" / "observations.csv"
    true = read_table(path, ("flower_id", "cluster_id"))
    found = read_table(folder / "observations.csv", ("flower_id", "cluster_id"), ignored=("timestamp", "reason", "nis"))
    if len(true) != len(found):
        raise InputError(f"{path}: {len(true)} rows, expected {len(found)} as in {folder / 'observations.csv'}")
    session, _, _ = names_of(folder, run.session_path, run.session)
    columns = (
        (table.columns[name].astype(np.int64) for table in (found, true)) for name in ("cluster_id", "flower_id")
    )
    clusters, flowers = (_majority(*pair) for pair in columns)
    return session, (clusters, flowers)


def _majority(local: IntArray, true: IntArray) -> dict[int, int]:
    """The most frequent true id of each local id; the smallest of several."""
    pairs, counts = np.unique(np.stack([local, true], axis=1), axis=0, return_counts=True)
    out = {}
    for k in np.argsort(counts, kind="stable"):
        out[int(pairs[k, 0])] = int(pairs[k, 1])
    return out


def _verdict(store: MapStore, truth: Mapping[str, tuple[dict[int, int], dict[int, int]]], kind: int) -> Verdict:
    total = Confusion()
    known: dict[int, int] = {}
    said: list[tuple[float, bool, bool]] = []
    for session in store.sessions():
        rows = _decisions(store, session, kind)
        true = np.array([truth[session.session][kind].get(local, CLUTTER) for local in rows[:, 0].astype(int).tolist()])
        ids, is_new, probability = rows[:, 1].astype(np.int64), rows[:, 2] > 0, rows[:, 3]
        is_first = session.evidence != session.evidence
        if not is_first:
            said += _outcomes(true, ids, is_new, probability, known)
        score = confusion(true.astype(np.int64), ids, is_new, known)
        total = total if is_first else total + score
    table = np.array(said, dtype=float).reshape(-1, 3)
    return Verdict(total, reliability(table[table[:, 1] == 0]), reliability(table[table[:, 1] == 1]))


def _decisions(store: MapStore, session: StoredSession, kind: int) -> Array:
    """Local id, id in the map, whether it is new, and its probability (n, 4)."""
    table, column = (("observations", "cluster_id"), ("flower_observations", "flower_id"))[kind]
    rows = store.read(
        f"SELECT local_id, {column}, is_new, probability FROM {table} WHERE session_id = ? AND local_id IS NOT NULL",
        (session.id,),
    )
    return np.array(rows, dtype=float).reshape(-1, 4)


def _outcomes(
    true: IntArray, ids: IntArray, is_new: BoolArray, probability: Array, known: Mapping[int, int]
) -> list[tuple[float, bool, bool]]:
    """Probability, whether it was called new, and whether that was right, of each decision."""
    there = set(known.values())
    out = []
    for real, name, new, p in zip(true.tolist(), ids.tolist(), is_new.tolist(), probability.tolist(), strict=True):
        is_right = (real < 0 or real not in there) if new else (real >= 0 and known.get(name) == real)
        out.append((p, new, is_right))
    return out


def reliability(decisions: Array) -> list[Bin]:
    """Bins of decisions (n, 3): probability, anything, whether it was right; empty ones are left out."""
    out = []
    for low, high in pairwise(EDGES):
        use = (decisions[:, 0] >= low) & ((decisions[:, 0] < high) | (high == EDGES[-1]))
        if use.any():
            out.append(Bin(float(decisions[use, 0].mean()), float(decisions[use, 2].mean()), int(use.sum())))
    return out
