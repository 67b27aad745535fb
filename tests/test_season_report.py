"""The season report: all that the map knows is in the page, and the page asks nothing of the network."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from map_help import SMALL, map_of, rest_incoming, result_of

from cluster_slam.cli.app import run
from cluster_slam.io.map.ledger import record
from cluster_slam.pipeline.remember import add
from cluster_slam.remember.judge import reliability
from cluster_slam.simulate.season import SeasonPlant


def test_the_page_holds_the_season(tmp_path: Path) -> None:
    plant = SeasonPlant(SMALL, seed=0)
    with map_of(tmp_path, plant, "row <b> 3") as store:
        record(store, 2, "pollinated", 1.7e9, "</script><b>note")
        plant.grow_to(3.0)
        added = add(store, rest_incoming(plant))
        n_clusters = len(store.plants()[0].cluster_ids)
        path = store.path
    assert run(["map", "report", str(path), "-o", str(tmp_path / "season.html"), "--quiet"]) == 0
    page = (tmp_path / "season.html").read_text("utf-8")
    assert "default-src 'none'" in page
    assert not re.findall(r"(?:src|href)\s*=", page)
    content = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert content is not None
    data = json.loads(content[1])["plants"][0]
    assert len(data["sessions"]) == 2
    assert len(data["clusters"]) == n_clusters
    assert data["clusters"][2]["events"][0]["note"] == "</script><b>note"
    seen = [sum(isinstance(c["life"][k], list) for c in data["clusters"]) for k in (0, 1)]
    assert seen[1] == added.n_known + added.n_new
    assert len(data["sessions"][1]["before"]) == seen[1]


def test_an_empty_map_has_a_page(tmp_path: Path) -> None:
    assert run(["map", "create", str(tmp_path / "m.map"), "--quiet"]) == 0
    assert run(["map", "report", str(tmp_path / "m.map"), "-o", str(tmp_path / "p.html"), "--quiet"]) == 0
    assert run(["map", "report", str(tmp_path / "m.map"), "-o", str(tmp_path / "no" / "p.html"), "--quiet"]) == 2


def with_truth(folder: Path, plant: SeasonPlant) -> Path:
    """Today's result, and a session with the truth about its observations beside it."""
    state = plant.rng.bit_generator.state
    rest = plant.rest()
    plant.rng.bit_generator.state = state
    result = result_of(folder, plant)
    session = folder.with_name(f"{folder.name}-session")
    (session / "truth").mkdir(parents=True)
    true = dict(zip(rest.constellation.cluster_ids.tolist(), rest.true_clusters.tolist(), strict=True))
    clusters = [true[c] for c in rest.constellation.flower_cluster_ids.tolist()]
    rows = [f"{f},{c}" for f, c in zip(rest.true_flowers.tolist(), clusters, strict=True)]
    (session / "truth" / "observations.csv").write_text("\n".join(["flower_id,cluster_id", *rows, ""]))
    run_json = json.loads((result / "run.json").read_text())
    (result / "run.json").write_text(json.dumps(run_json | {"session_path": str(session)}))
    seen = zip(rest.constellation.flower_ids.tolist(), rest.constellation.flower_cluster_ids.tolist(), strict=True)
    lines = ["timestamp,flower_id,cluster_id", *(f"{rest.constellation.start:.6f},{f},{c}" for f, c in seen)]
    (result / "observations.csv").write_text("\n".join([*lines, ""]))
    return result


def test_against_the_truth(tmp_path: Path) -> None:
    plant, path = SeasonPlant(SMALL, seed=0), str(tmp_path / "m.map")
    results = []
    assert run(["map", "create", path, "--quiet"]) == 0
    for day in (0.0, 2.0):
        plant.grow_to(day)
        results.append(with_truth(tmp_path / f"day-{day:g}", plant))
        assert run(["map", "add", path, str(results[-1]), "--quiet"]) == 0
    told = [word for result in results for word in ("--truth", str(result))]
    assert run(["map", "report", path, "-o", str(tmp_path / "p.html"), *told, "--quiet"]) == 0
    content = re.search(r'<script id="data" type="application/json">(.*?)</script>', (tmp_path / "p.html").read_text())
    assert content is not None
    clusters, flowers = json.loads(content[1])["judged"]
    assert clusters["confusion"] == {"right": 7, "wrong": 0, "missed": 0, "joined": 0, "new": 0}
    assert clusters["f1"] == 1.0
    assert sum(b["n"] for b in flowers["matches"]) == sum(flowers["confusion"][w] for w in ("right", "wrong", "joined"))
    assert flowers["confusion"]["right"] > 20
    assert run(["map", "report", path, "-o", str(tmp_path / "q.html"), *told[:2], "--quiet"]) == 2  # one is missing
    (tmp_path / "day-2-session" / "truth" / "observations.csv").write_text("flower_id,cluster_id\n1,1\n")
    assert run(["map", "report", path, "-o", str(tmp_path / "q.html"), *told, "--quiet"]) == 2


def test_reliability_in_bins() -> None:
    decisions = np.array([[0.4, 0, 1], [0.6, 0, 0], [0.7, 0, 1], [1.0, 0, 1], [0.9995, 0, 0]])
    bins = reliability(decisions)
    assert [b.n for b in bins] == [1, 2, 2]
    assert (bins[1].said, bins[1].right) == (pytest.approx(0.65), 0.5)
    assert bins[2].right == 0.5
