"""The map on recordings of other people (CLUSTER_SLAM_DATA): fruits of a tree over months, strawberry plants."""

from __future__ import annotations

import os
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tables import Tables

from cluster_slam import open_session, smooth
from cluster_slam.constellation.similarity import align
from cluster_slam.geometry import Array
from cluster_slam.io.map import create_map
from cluster_slam.io.map.incoming import Incoming, read_incoming
from cluster_slam.io.map.store import MapStore
from cluster_slam.io.result import write_result
from cluster_slam.io.session import open_truth
from cluster_slam.pipeline.remember import add, match_all
from cluster_slam.records import IntArray

DATA = Path(os.environ.get("CLUSTER_SLAM_DATA", "/nowhere"))
NEAR_M = 0.08  # nearest neighbours farther away are none
pytestmark = [
    pytest.mark.nightly,
    pytest.mark.recordings,
    pytest.mark.skipif(not DATA.is_dir(), reason="CLUSTER_SLAM_DATA names no folder of recordings"),
]
Called = dict[int, int]  # true id of each fruit -> what it was called


@cache
def smoothed(name: str, folder: Path) -> tuple[Incoming, Array, IntArray, IntArray]:
    """A session as a map takes it, its points, the true id and the result's id of each of them."""
    session = open_session(DATA / name)
    truth = open_truth(DATA / name, session)
    assert truth is not None
    assert truth.flower_ids is not None
    result = smooth(session)
    write_result(result, folder / name)
    return read_incoming(folder / name), session.observations.points, truth.flower_ids, result.flower_ids


def trees() -> list[str]:
    return sorted({"-".join(p.name.split("-")[:3]) for p in DATA.glob("apples-*-labels")})


def dates(tree: str, kind: str) -> list[str]:
    return sorted(p.name for p in DATA.glob(f"{tree}-*-{kind}"))


def called(store: MapStore, name: str, folder: Path, *, is_first: bool) -> Called:
    """What a map calls the fruits of a session that nobody named; nothing where it is refused."""
    incoming, _, true, own = smoothed(name, folder)
    added = add(store, incoming, any_plant=not is_first, similarity=True)
    if added.session is None:
        return {t: -1 for t in true.tolist() if t >= 0}
    rows = store.read("SELECT local_id, flower_id FROM flower_observations WHERE session_id = ?", (added.session.id,))
    names = dict(rows)
    return {t: names.get(f, -1) for t, f in zip(true.tolist(), own.tolist(), strict=True) if t >= 0}


def count(a: Called, b: Called) -> Array:
    """Right, claimed and possible pairs of the fruits of two dates."""
    known = {name for name in a.values() if name >= 0}
    right = sum(t in a and name >= 0 and a[t] == name for t, name in b.items())
    return np.array([right, sum(name in known for name in b.values()), len(set(a) & set(b))], dtype=float)


def f1(counts: Array) -> float:
    return float(2 * counts[0] / (counts[1] + counts[2]))


def nearest(first: str, second: str, folder: Path) -> Array:
    """The same for nearest neighbours after the best similarity, which is fitted to the true pairs."""
    (_, p, i, _), (_, q, j, _) = smoothed(first, folder), smoothed(second, folder)
    common = sorted(set(i[i >= 0].tolist()) & set(j.tolist()))
    a = np.array([p[i == t][0, :2] for t in common])
    b = np.array([q[j == t][0, :2] for t in common])
    moved = align(b[None], a[None], (0.9, 1.1)).apply(q[:, :2])[0]
    distance = np.linalg.norm(moved[:, None] - p[:, :2], axis=2)
    chosen, use = i[distance.argmin(1)], (j >= 0) & (distance.min(1) < NEAR_M)
    use &= chosen >= 0
    return np.array([(chosen[use] == j[use]).sum(), use.sum(), len(common)], dtype=float)


@pytest.mark.parametrize(("kind", "wanted"), [("labels", (0.97, 0.94)), ("yolo", (0.96, 0.92))])
def test_apples(
    kind: str, wanted: tuple[float, float], tmp_path_factory: pytest.TempPathFactory, add_row: Tables
) -> None:
    folder = tmp_path_factory.mktemp("apples")
    alone, next_date, later = np.zeros(3), np.zeros(3), np.zeros(3)
    plain = {1: np.zeros(3), 4: np.zeros(3)}
    for tree in trees():
        names = dates(tree, kind)
        with create_map(folder / f"{tree}.map") as store:
            history = [called(store, name, folder, is_first=k == 0) for k, name in enumerate(names)]
        next_date += sum(count(a, b) for a, b in pairwise(history))
        later += sum(count(a, b) for a, b in zip(history, history[4:], strict=False))
        for k, (a, b) in enumerate(pairwise(names)):
            with create_map(folder / f"{tree}-{k}.map") as store:
                alone += count(called(store, a, folder, is_first=True), called(store, b, folder, is_first=False))
        for lag in plain:
            plain[lag] += sum(nearest(a, b, folder) for a, b in zip(names, names[lag:], strict=False))
    columns = {"next_date_alone": f1(alone), "next_date_through_the_map": f1(next_date), "four_dates_on": f1(later)}
    columns |= {"oracle_and_nearest_1": f1(plain[1]), "oracle_and_nearest_4": f1(plain[4])}
    add_row("apples", kind=kind, **columns)
    assert f1(alone) >= wanted[0]
    assert f1(later) >= wanted[1]


@pytest.mark.parametrize(("kind", "wanted"), [("strict", 4), ("lenient", 3)])
def test_strawberries(kind: str, wanted: int, tmp_path_factory: pytest.TempPathFactory, add_row: Tables) -> None:
    folder = tmp_path_factory.mktemp("strawberries")
    n_first, n_right, n_wrong = 0, 0, 0
    with create_map(folder / "s.map") as store:
        for n in range(1, 7):
            add(store, smoothed(f"strawberry{n}-labels", folder)[0], plant=str(n))
        for n in range(1, 7):
            decision = match_all(store, smoothed(f"strawberry{n}-{kind}", folder)[0])
            n_first += decision.matches[0].name == str(n)
            n_right += decision.accepted is not None and decision.accepted.name == str(n)
            n_wrong += decision.accepted is not None and decision.accepted.name != str(n)
    add_row("strawberries", kind=kind, right_first=n_first, accepted=n_right, wrong_accepted=n_wrong)
    assert n_first >= wanted
    assert n_wrong == 0
