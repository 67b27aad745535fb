"""The animated replay in the report of ``track``: what it holds, and that it plays in a real browser."""

from __future__ import annotations

import base64
import json
import re
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, browser

from cluster_slam import track
from cluster_slam.online.journal import journal_of, read_journal
from cluster_slam.pipeline.track import instants_of
from cluster_slam.records import Result
from cluster_slam.report.page import render_report
from cluster_slam.report.replay import Instants, replay_json, with_replay
from cluster_slam.simulate import PRESETS, simulate_session


@cache
def tracked(folder: Path) -> tuple[Result, Instants]:
    made = simulate_session(replace(PRESETS["sample"], duration_s=4.0), seed=9)
    result = track(made.session, out=folder / "out")
    return result, instants_of(read_journal(journal_of(folder / "out")))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Result, Instants]:
    return tracked(tmp_path_factory.mktemp("replay"))


def test_instants_are_all_known_clusters_ten_times_a_second(run: tuple[Result, Instants]) -> None:
    result, instants = run
    stamps = result.session.stamps[np.unique(instants.frame)]
    assert 25 <= len(stamps) <= 41
    assert (np.diff(stamps) > 0.09).all()
    assert set(result.clusters.ids.tolist()) <= set(instants.cluster.tolist())
    assert (np.linalg.eigvalsh(instants.cov)[:, 0] > 0).all()
    last = instants.frame == instants.frame[-1]
    rest = {int(i): p for i, p in zip(result.clusters.ids, result.clusters.positions, strict=True)}
    pairs = zip(instants.cluster[last].tolist(), instants.position[last], strict=True)
    gaps = [float(np.linalg.norm(position - rest[cluster])) for cluster, position in pairs if cluster in rest]
    assert len(gaps) >= 3
    assert min(gaps) < 0.005  # flowers are still being grouped, and some sway, so single ones differ
    assert max(gaps) < 0.05


def test_the_picture_is_that_of_the_camera() -> None:
    """A camera that looks along y with z up sees x to the right and z upwards; an ellipse keeps its axes."""
    made = simulate_session(replace(PRESETS["sample"], duration_s=0.2), seed=9)
    T = np.tile(np.eye(4), (made.session.n_frames, 1, 1))
    T[:, :3, :3] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    instants = Instants(
        frame=np.array([0, 0, 2]),
        cluster=np.array([7, 9, 7]),
        position=np.array([[0.0, 5, 0], [1, 5, 2], [0, 5, 1]]),
        cov=np.tile(np.diag([1e-4, 9.0, 4e-4]), (3, 1, 1)),
        state=np.array([1, 2, 1]),
        sways=np.array([0, 0, 1]),
        seen=np.array([1, 0, 1]),
    )
    result = replace(track(made.session), T_world_camera=T)
    data = replay_json(result, instants)
    assert numbers(data["p"], "<f4").reshape(3, 2) == pytest.approx(np.array([[0, -1], [1, 1], [0, 0]]))
    assert numbers(data["cov"], "<f4").reshape(3, 3)[0] == pytest.approx([1e-4, 0, 4e-4])
    assert numbers(data["first"], "<u4").tolist() == [0, 2, 3]
    assert numbers(data["what"], "u1").tolist() == [9, 2, 13]
    assert data["ids"] == [7, 9]


def numbers(packed: object, kind: str) -> np.ndarray:
    assert isinstance(packed, dict)
    return np.frombuffer(base64.b64decode(packed["b"]), kind)


def test_nothing_to_play_leaves_the_page_as_it_is(run: tuple[Result, Instants]) -> None:
    result, instants = run
    none = Instants(*(getattr(instants, name)[:0] for name in Instants.__slots__))
    assert with_replay("<main></main>", result, none) == "<main></main>"


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_it_plays(run: tuple[Result, Instants], tmp_path: Path) -> None:
    result, instants = run
    path = tmp_path / "report.html"
    path.write_text(with_replay(render_report(result), result, instants), encoding="utf-8")
    found = re.search(r'id="replay-data">(.*?)</script>', path.read_text("utf-8"), re.S)
    assert found is not None
    assert json.loads(found[1])["ids"]
    with browser() as page:
        page.open(path)
        assert page.problems == []
        before = page.value("document.getElementById('replay-canvas').toDataURL()")
        page.value("document.getElementById('replay-play').click()")
        end = time.monotonic() + 20
        while page.value("Number(document.getElementById('replay-slider').value)") < 3:
            assert time.monotonic() < end
            time.sleep(0.1)
        assert page.value("document.getElementById('replay-canvas').toDataURL()") != before
        assert "tracked" in page.value("document.getElementById('replay-words').textContent")
        assert page.problems == []
