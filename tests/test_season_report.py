"""The season report: all that the map knows is in the page, and the page asks nothing of the network."""

from __future__ import annotations

import json
import re
from pathlib import Path

from map_help import SMALL, map_of, rest_incoming

from cluster_slam.cli.app import run
from cluster_slam.io.map.ledger import record
from cluster_slam.pipeline.remember import add
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
