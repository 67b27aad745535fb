"""A map on disk: what goes in comes out, undo is exact, faults leave it whole, and the ledger answers."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from map_help import SMALL, landmark_file, map_of, rest_incoming, result_of

from cluster_slam.cli.app import run
from cluster_slam.errors import InputError, OutputError
from cluster_slam.io.map import create_map, open_map
from cluster_slam.io.map.check import problems
from cluster_slam.io.map.incoming import read_incoming, read_landmarks
from cluster_slam.io.map.ledger import ask, events, record
from cluster_slam.io.map.merge import merge_map
from cluster_slam.io.map.store import MapStore, refused
from cluster_slam.io.map.times import iso, seconds
from cluster_slam.io.map.write import undo
from cluster_slam.pipeline.remember import add
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.season import SeasonPlant


def dump(store: MapStore) -> list[str]:
    """All that a map says, but for the counters: ids are never used twice."""
    return [line for line in store.connection.iterdump() if "counters" not in line]


def grown(seed: int = 0, *days: float) -> SeasonPlant:
    plant = SeasonPlant(SMALL, seed=seed)
    for day in days:
        plant.grow_to(day)
    return plant


# --- what goes in comes out


def test_a_plant_is_read_as_it_was_written(tmp_path: Path) -> None:
    plant = grown()
    incoming = rest_incoming(plant)
    with create_map(tmp_path / "m.map") as store:
        add(store, incoming, plant="row3")
        found = store.plant("row3")
    np.testing.assert_array_equal(found.flowers, incoming.constellation.flowers)
    np.testing.assert_array_equal(found.flower_covs, incoming.constellation.flower_covs)
    np.testing.assert_allclose(found.clusters, incoming.constellation.clusters, atol=1e-12)
    assert found.cluster_presence.min() == 1.0
    assert found.last_session == incoming.constellation.end


def test_velocity_of_a_cluster_that_was_seen_twice(tmp_path: Path) -> None:
    """Both sessions in one frame, one cluster shifted by 8 mm in 4 days: a part of 2 mm/day by the Kalman gain."""
    with map_of(tmp_path, grown()) as store:
        before = store.plant("row3")
        first = rest_incoming(grown()).constellation
        shift = np.zeros_like(first.flowers)
        shift[first.flower_cluster_ids == 2] = [0.008, 0.0, 0.0]
        later = replace(first, session="later", start=first.start + 4 * 86400, end=first.end + 4 * 86400)
        add(store, replace(rest_incoming(grown()), constellation=replace(later, flowers=first.flowers + shift)))
        after = store.plant("row3")
    row = np.searchsorted(after.cluster_ids, before.cluster_ids[2])
    velocity = after.velocities[row] * 86400
    sigma = 0.003 / np.sqrt(3.0)  # m/day an axis, prior
    share = velocity[0] / 0.002
    assert 0.3 < share < 1.0  # the rest is the walk, the wander of the drift, and what the others' fit takes
    assert np.abs(velocity[1:]).max() < 0.3 * sigma
    assert np.trace(after.velocity_covs[row]) < np.trace(before.velocity_covs[2])


def test_undo_is_exact(tmp_path: Path) -> None:
    plant = grown()
    with map_of(tmp_path, plant) as store:
        one = dump(store)
        plant.grow_to(3.0)
        assert add(store, rest_incoming(plant)).session is not None
        two = dump(store)
        plant.grow_to(7.0)
        assert add(store, rest_incoming(plant)).session is not None
        undo(store)
        assert dump(store) == two
        undo(store)
        assert dump(store) == one
        undo(store)
        assert store.plants() == []
        with pytest.raises(InputError, match="no session to undo"):
            undo(store)


def test_ids_are_never_used_twice(tmp_path: Path) -> None:
    plant = grown()
    with map_of(tmp_path, plant) as store:
        before = set(store.plant("row3").cluster_ids.tolist())
        undo(store)
        add(store, rest_incoming(plant), plant="row3")
        assert not before & set(store.plant("row3").cluster_ids.tolist())


def test_a_session_is_added_once(tmp_path: Path) -> None:
    plant = grown()
    with map_of(tmp_path, plant) as store:
        before = dump(store)
        with pytest.raises(InputError, match="is in the map already"):
            add(store, rest_incoming(plant))
        assert dump(store) == before


def test_sessions_come_in_the_order_of_time(tmp_path: Path) -> None:
    plant = grown(0, 3.0)
    with map_of(tmp_path, plant) as store:
        early = rest_incoming(grown())
        with pytest.raises(InputError, match="in the order of time"):
            add(store, early)
        assert problems(store) == []


def test_millimetres_are_refused(tmp_path: Path) -> None:
    incoming = rest_incoming(grown())
    large = replace(incoming.constellation, flowers=1000.0 * incoming.constellation.flowers)
    with create_map(tmp_path / "m.map") as store, pytest.raises(InputError, match="millimetres"):
        add(store, replace(incoming, constellation=large))


def test_another_unit_or_frame_is_refused(tmp_path: Path) -> None:
    """Centimetres, and a left-handed frame, of the very plant: the map says no and stays as it was."""
    plant = grown()
    with map_of(tmp_path, plant) as store:
        before = dump(store)
        plant.grow_to(1.0)
        incoming = rest_incoming(plant)
        flowers = incoming.constellation.flowers
        for wrong in (100.0 * flowers, flowers * [1.0, 1.0, -1.0]):
            other = replace(incoming, constellation=replace(incoming.constellation, flowers=wrong))
            refused = add(store, other, plant="row3")
            assert refused.session is None
            assert "no match" in refused.decision.reason
            assert dump(store) == before
        assert add(store, incoming, plant="row3").session is not None


def test_a_named_plant_must_align(tmp_path: Path) -> None:
    with map_of(tmp_path, grown()) as store:
        before = dump(store)
        other = rest_incoming(grown(9))
        refused = add(store, other, plant="row3")
        assert refused.session is None
        assert "no match" in refused.decision.reason
        assert add(store, other).session is None  # nor without a name
        assert dump(store) == before
        assert add(store, other, new_plant=True).session is not None  # but it may found another
        assert store.plant_names() == ["row3", "plant-2"]


def test_landmarks_of_a_table(tmp_path: Path) -> None:
    path = landmark_file(tmp_path / "rest.csv", grown())
    incoming = read_landmarks(path, time=None)
    assert np.isnan(incoming.constellation.start)
    with create_map(tmp_path / "m.map") as store:
        add(store, incoming, plant="row3")
        assert len(store.plant("row3").flower_ids) == len(incoming.constellation.flower_ids)
    path.write_text(path.read_text() + path.read_text().splitlines()[1] + "\n")
    with pytest.raises(InputError, match="a second time"):
        read_landmarks(path, time=None)


# --- the command line


def test_add_completes_the_result(tmp_path: Path) -> None:
    plant, path = grown(), tmp_path / "m.map"
    first = result_of(tmp_path / "monday", plant)
    plant.grow_to(3.0)
    second = result_of(tmp_path / "thursday", plant)
    assert run(["map", "create", str(path), "--quiet"]) == 0
    assert run(["map", "add", str(path), str(first), "--quiet"]) == 0
    assert run(["map", "add", str(path), str(second), "--quiet"]) == 0
    lines = (second / "identities.csv").read_text().splitlines()
    assert lines[0] == "cluster_id,map_id,probability,new_map_id"
    assert sum(line.split(",")[1] != "" for line in lines[1:]) >= 5
    for line in lines[1:]:
        _, known, probability, new = line.split(",")
        assert (known == "") != (new == "")
        assert 0.0 <= float(probability) <= 1.0
    told = json.loads((second / "run.json").read_text())
    assert told["aligned"] is True
    assert len(told["T_map_world"]) == 7
    assert np.array(told["T_map_world_cov"]).shape == (6, 6)
    assert run(["map", "add", str(path), str(second), "--quiet"]) == 2  # a second time
    (second / "identities.csv").unlink()  # as if it had been killed between map and result
    assert run(["map", "add", str(path), str(second), "--quiet"]) == 0
    assert (second / "identities.csv").read_text().splitlines() == lines
    assert run(["map", "check", str(path), "--quiet"]) == 0
    assert run(["map", "show", str(path)]) == 0


def test_match_ranks_and_changes_nothing(tmp_path: Path) -> None:
    plant, path = grown(), tmp_path / "m.map"
    with create_map(path) as store:
        add(store, rest_incoming(grown(9)), plant="other")
        add(store, rest_incoming(plant), plant="row3")
        before = dump(store)
    plant.grow_to(2.0)
    result = result_of(tmp_path / "unknown", plant)
    assert run(["map", "match", str(path), str(result), "--quiet"]) == 0
    rows = [line.split(",") for line in (result / "matches.csv").read_text().splitlines()]
    assert rows[0][:4] == ["plant", "log_likelihood_ratio", "probability", "accepted"]
    assert [row[0] for row in rows[1:]] == ["row3", "other"]
    assert [row[3] for row in rows[1:]] == ["true", "false"]
    with open_map(path) as store:
        assert dump(store) == before


def test_a_refusal_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with map_of(tmp_path, grown()) as store:
        before = dump(store)
        result = result_of(tmp_path / "other", grown(9))
        assert run(["map", "add", str(store.path), str(result), "--quiet"]) == 1
        assert "refused, the map is unchanged: no match" in capsys.readouterr().err
        assert json.loads((result / "run.json").read_text())["aligned"] is False
        assert dump(store) == before


def test_export(tmp_path: Path) -> None:
    plant = grown()
    with map_of(tmp_path, plant) as store:
        record(store, 0, "pollinated", 1.7e9, 'with a brush, "twice"')
    assert run(["map", "export", str(tmp_path / "row3.map"), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    clusters = (tmp_path / "out" / "clusters.csv").read_text().splitlines()
    wanted = "map_id,plant,x,y,z,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz,presence,last_looked_at,last_seen,state"
    assert clusters[0].startswith(wanted)
    assert (tmp_path / "out" / "flowers.csv").read_text().splitlines()[0] == wanted + ",cluster_map_id"
    sessions = (tmp_path / "out" / "sessions.csv").read_text().splitlines()
    assert sessions[0].startswith("id,plant,start,tx,ty,tz,qx,qy,qz,qw")
    assert '"with a brush, ""twice"""' in (tmp_path / "out" / "events.csv").read_text()
    assert (tmp_path / "out" / "map.g2o").exists()


def test_predict(tmp_path: Path) -> None:
    with map_of(tmp_path, grown()):
        pass
    out = tmp_path / "p.csv"
    assert run(["map", "predict", str(tmp_path / "row3.map"), "--date", "2026-05-11", "-o", str(out), "--quiet"]) == 0
    rows = np.loadtxt(out, delimiter=",", skiprows=1, usecols=range(2, 12))
    gap = (seconds("2026-05-11") - 1_777_888_800.0) / 86400
    assert (rows[:, 3] > (0.8 * 0.003 * gap) ** 2 / 3).all()  # at least the drift that is expected
    assert (rows[:, 3] < (2.0 * 0.003 * gap + 0.01) ** 2 / 3).all()


# --- the ledger


def test_questions(tmp_path: Path) -> None:
    with map_of(tmp_path, grown()) as store:
        plant = store.plant("row3")
        many = {i for i, n in zip(plant.cluster_ids.tolist(), plant.n_flowers.tolist(), strict=True) if n >= 4}
        assert {row.map_id for row in ask(store, "n_flowers >= 4")} == many
        done = sorted(many)[0]
        record(store, done, "pollinated", seconds("2026-05-05"), "")
        assert {row.map_id for row in ask(store, "n_flowers >= 4 and not pollinated")} == many - {done}
        assert {row.map_id for row in ask(store, "pollinated since 2026-05-04")} == {done}
        assert ask(store, "pollinated since 2026-05-06") == []
        assert ask(store, "plant = nobody") == []
        for wrong in ("n_flower >= 3", "n_flowers >= three", "n_flowers >=", "last_seen < soon"):
            with pytest.raises(InputError):
                ask(store, wrong)
        with pytest.raises(InputError, match="no cluster 999"):
            record(store, 999, "pollinated", 0.0, "")


def test_events_stay_with_their_cluster(tmp_path: Path) -> None:
    plant = grown()
    with map_of(tmp_path, plant) as store:
        record(store, 3, "pollinated", 1.7e9, "a")
        plant.grow_to(5.0)
        add(store, rest_incoming(plant))
        undo(store)
        assert [(e.cluster, e.note) for e in events(store)] == [(3, "a")]
        with pytest.raises(InputError, match="events are recorded"):
            undo(store)  # the session that brought cluster 3


def test_events_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with map_of(tmp_path, grown()) as store:
        path = str(store.path)
    assert run(["map", "event", path, "3", "pollinated", "--time", "2026-05-06", "--note", "brush", "--json"]) == 0
    done = json.loads(capsys.readouterr().out)
    assert (done["map_id"], done["time"], done["note"]) == (3, seconds("2026-05-06"), "brush")
    assert run(["map", "event", path, "--json"]) == 0
    assert [e["event"] for e in json.loads(capsys.readouterr().out)["events"]] == [done["event"]]
    assert run(["map", "event", path, "3", "--delete", str(done["event"])]) == 2  # which of the two?
    assert run(["map", "event", path, "--delete", str(done["event"]), "--quiet"]) == 0
    assert run(["map", "event", path, "--delete", str(done["event"]), "--quiet"]) == 2
    assert run(["map", "event", path, "999", "note", "--quiet"]) == 2
    with open_map(path) as store:
        assert events(store) == []


def test_dates() -> None:
    assert seconds("1970-01-02") == 86400.0
    assert seconds("1970-01-01T01:00+01:00") == 0.0
    assert iso(0.0) == "1970-01-01T00:00:00Z"
    assert iso(float("nan")) == ""
    with pytest.raises(InputError, match="ISO 8601"):
        seconds("tomorrow")


# --- merging


def test_merge(tmp_path: Path) -> None:
    with map_of(tmp_path, grown(), "a") as one, map_of(tmp_path, grown(5), "b") as two:
        record(two, 1, "note", 0.0, "hello")
        names, n = merge_map(one, two)
        assert (names, n) == (["b"], len(two.plant("b").cluster_ids))
        np.testing.assert_array_equal(one.plant("b").flowers, two.plant("b").flowers)
        assert set(one.plant("a").flower_ids.tolist()).isdisjoint(one.plant("b").flower_ids.tolist())
        assert events(one)[0].cluster == one.plant("b").cluster_ids[1]
        assert problems(one) == []
        with pytest.raises(InputError, match="is in both maps"):
            merge_map(one, two)


def test_merge_of_plants_of_one_name(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with map_of(tmp_path, grown(), "a") as one, map_of(tmp_path / "other", grown(5), "a") as two:
        before = dump(one)
        with pytest.raises(InputError, match="--rename a=NEW"):
            merge_map(one, two)
        with pytest.raises(InputError, match="no plant 'x' to rename"):
            merge_map(one, two, names={"x": "y"})
        assert dump(one) == before
    path, other = str(tmp_path / "a.map"), str(tmp_path / "other" / "a.map")
    assert run(["map", "merge", path, other, "--quiet"]) == 2
    assert run(["map", "merge", path, other, "--rename", "a", "--quiet"]) == 2
    assert run(["map", "merge", path, other, "--rename", "a=b", "--quiet"]) == 0
    with open_map(path) as store:
        assert store.plant_names() == ["a", "b"]
        assert problems(store) == []


# --- faults


def test_not_a_map(tmp_path: Path) -> None:
    other = tmp_path / "other.db"
    sqlite3.connect(other).execute("CREATE TABLE t (x)").connection.close()
    text = tmp_path / "text.map"
    text.write_text("x" * 4000)
    for path, words in ((other, "no map"), (text, "no map"), (tmp_path, "folder"), (tmp_path / "none", "missing")):
        with pytest.raises(InputError, match=words):
            open_map(path)
    assert run(["map", "show", str(text)]) == 2
    with pytest.raises(OutputError, match="exists already"):
        create_map(text)


def test_a_newer_schema(tmp_path: Path) -> None:
    with map_of(tmp_path, grown()) as store:
        store.connection.execute("PRAGMA user_version=99")
    with pytest.raises(InputError, match="schema version 99"):
        open_map(tmp_path / "row3.map")


def test_two_writers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cluster_slam.io.map.store.BUSY_S", 0.05)
    plant = grown()
    with map_of(tmp_path, plant) as one, open_map(tmp_path / "row3.map") as two:
        plant.grow_to(3.0)
        with one.write(), pytest.raises(OutputError, match="another program"):
            add(two, rest_incoming(plant))
        assert add(two, rest_incoming(plant)).session is not None


def test_disk_full(tmp_path: Path) -> None:
    with map_of(tmp_path, grown()) as store:
        before = dump(store)
        pages = store.connection.execute("PRAGMA page_count").fetchone()[0]
        store.connection.execute(f"PRAGMA max_page_count={pages}")
        with pytest.raises(OutputError, match="disk is full"):
            add(store, rest_incoming(grown(5)), plant="another, with rows of its own")
        assert dump(store) == before
        assert problems(store) == []


def test_no_room_for_the_journal(tmp_path: Path) -> None:
    """SQLite calls it an I/O error: the map is not damaged."""
    error = refused(tmp_path / "a.map", sqlite3.OperationalError("disk I/O error"))
    assert isinstance(error, OutputError)
    assert "is the disk full?" in str(error)


def test_a_bug_on_the_way_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = grown()
    with map_of(tmp_path, plant) as store:
        before = dump(store)
        plant.grow_to(3.0)

        def broken(*_: object) -> None:
            raise ZeroDivisionError

        monkeypatch.setattr("cluster_slam.io.map.write._observations", broken)
        with pytest.raises(ZeroDivisionError):
            add(store, rest_incoming(plant))
        assert dump(store) == before


def test_check_finds_damage(tmp_path: Path) -> None:
    damages = {
        "of no cluster": "UPDATE flowers SET cluster_id = 9999 WHERE id = 0",
        "not positive definite": "UPDATE clusters SET cov_xx = -1 WHERE id = 1",
        "outside 0 to 1": "UPDATE flowers SET presence = 2 WHERE id = 0",
        "journal is damaged": "UPDATE journal SET before = x'00'",
        "a value cannot be read": "UPDATE sessions SET cov = '[1, 2'",
        "alignment's covariance": "UPDATE sessions SET cov = replace(cov, '[', '[-1') WHERE id = 1",
        "alignment is not finite": "UPDATE sessions SET tx = 1e999 WHERE id = 1",
    }
    with map_of(tmp_path, grown()) as store:
        assert problems(store) == []
        store.connection.execute("PRAGMA foreign_keys=OFF")
        for words, damage in damages.items():
            store.connection.execute("SAVEPOINT d")
            store.connection.execute(damage)
            assert any(words in text for text in problems(store)), words
            store.connection.execute("ROLLBACK TO d")
            store.connection.execute("RELEASE d")


@pytest.mark.parametrize(
    ("command", "damage"),
    [
        (["undo"], "UPDATE journal SET before = x'00'"),
        (["undo"], "UPDATE journal SET before = 7"),
        (["show"], "UPDATE sessions SET cov = '[1, 2'"),
        (["report", "-o", "r.html"], "PRAGMA foreign_keys=OFF; UPDATE observations SET cluster_id = 9999"),
    ],
)
def test_damage_that_sqlite_cannot_see_is_told(
    command: list[str], damage: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with map_of(tmp_path, grown()) as store:
        store.connection.executescript(damage)
    assert run(["map", command[0], str(store.path), *command[1:]]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "is damaged" in said


def test_a_name_that_is_no_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SQLite quotes the damaged name in its own message, byte by byte."""
    map_of(tmp_path, grown()).close()
    path = tmp_path / "row3.map"
    content = path.read_bytes().replace(b"CREATE INDEX clusters_of_plant", b"CREATE IND\x95X clusters_of_plant")
    path.write_bytes(content)
    assert run(["map", "check", str(path)]) == 2
    assert "is damaged" in capsys.readouterr().err


def test_a_map_without_its_end_is_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SQLite reads what its last page lacks as zeros."""
    map_of(tmp_path, grown()).close()
    whole = next(tmp_path.glob("*.map")).read_bytes()
    cut = tmp_path / "cut" / "m.map"
    cut.parent.mkdir()
    for share in (0.5, 0.9, 0.97, 0.999):
        cut.write_bytes(whole[: int(share * len(whole))])
        for command in ("check", "list", "undo"):
            assert run(["map", command, str(cut)]) == 2
            assert "is damaged" in capsys.readouterr().err
    cut.write_bytes(whole)
    assert run(["map", "check", str(cut)]) == 0


def test_a_journal_may_hold_what_the_file_lacks(tmp_path: Path) -> None:
    """As where the program was killed while the journal was brought in."""
    with map_of(tmp_path, grown()) as store:
        store.connection.execute("PRAGMA wal_autocheckpoint=0")
        with store.write() as connection:
            connection.execute("UPDATE flowers SET presence = 0.5")
        torn = tmp_path / "torn" / "m.map"
        torn.parent.mkdir()
        for end in ("", "-wal"):
            torn.with_name(torn.name + end).write_bytes(store.path.with_name(store.path.name + end).read_bytes())
    with torn.open("ab") as file:
        file.write(bytes(100))
    with open_map(torn) as store:
        assert problems(store) == []
        assert store.read("SELECT min(presence), max(presence) FROM flowers") == [(0.5, 0.5)]


def kill_during_add(folder: Path, n: int, seed: int) -> None:
    """Kill ``map add`` at random moments: the map is as before or complete, and adding again finishes the work."""
    rng = np.random.default_rng(seed)
    plant, path = grown(), folder / "m.map"
    create_map(path).close()
    run(["map", "add", str(path), str(result_of(folder / "first", plant)), "--quiet"])
    with open_map(path) as store:
        before = dump(store)
    plant.grow_to(1.0)
    result = result_of(folder / "second", plant)
    content = {e.name: e.read_bytes() for e in result.iterdir()}
    for moment in rng.uniform(0.0, 0.25, n).tolist():
        worker = os.fork()
        if worker == 0:
            os._exit(run(["map", "add", str(path), str(result), "--quiet"]))
        time.sleep(moment)
        os.kill(worker, signal.SIGKILL)
        os.waitpid(worker, 0)
        with open_map(path) as store:
            assert problems(store) == []
            is_complete = len(store.sessions()) == 2
            if not is_complete:
                assert dump(store) == before
        assert run(["map", "add", str(path), str(result), "--quiet"]) in (0, 2)  # 2: it was all done
        assert (result / "identities.csv").exists()
        run(["map", "undo", str(path), "--quiet"])
        for entry in result.iterdir():
            entry.unlink()
        for name, data in content.items():
            (result / name).write_bytes(data)


def test_kill_during_add(tmp_path: Path) -> None:
    kill_during_add(tmp_path, 20, 1)


# --- scale


def test_a_map_of_many_clusters_is_small(tmp_path: Path) -> None:
    with create_map(tmp_path / "m.map") as store:
        for k in range(50):
            add(store, rest_incoming(grown(k)), plant=f"plant {k}")
        n = sum(len(p.cluster_ids) for p in store.plants())
        store.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert (tmp_path / "m.map").stat().st_size / n < 5e6 / 1000


def test_two_plants_cannot_be_told_apart(tmp_path: Path) -> None:
    """Clones: one plant stands twice in the map. Without a name that is said, with a name it is none of a problem."""
    plant = grown()
    with map_of(tmp_path, plant, "a") as store:
        twin = replace(rest_incoming(grown()).constellation, session="twin")
        add(store, replace(rest_incoming(grown()), constellation=twin), plant="b")
        plant.grow_to(2.0)
        refused = add(store, rest_incoming(plant))
        assert refused.session is None
        assert "ambiguous" in refused.decision.reason
        assert "one plant twice, or do they overlap" in refused.decision.reason
        assert refused.decision.fits == ("a", "b")
        assert add(store, rest_incoming(plant), plant="a").session is not None


def test_a_plant_that_fits_as_well_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half of a plant is in the map as another one, too: taken for the whole plant, with a warning."""
    path, plant = str(tmp_path / "m.map"), SeasonPlant(replace(SMALL, session=SimulateConfig(n_clusters=12)), seed=0)
    whole = result_of(tmp_path / "whole", plant)
    half = SeasonPlant(plant.config, seed=0)
    keep = half.cluster < 3
    half.ids, half.cluster, half.offsets = half.ids[keep], half.cluster[keep], half.offsets[keep]
    part = result_of(tmp_path / "part", half)
    run_json = json.loads((part / "run.json").read_text())
    (part / "run.json").write_text(json.dumps(run_json | {"session": "part"}))
    plant.grow_to(1.0)
    today = result_of(tmp_path / "today", plant)
    assert run(["map", "create", path, "--quiet"]) == 0
    assert run(["map", "add", path, str(whole), "--plant", "whole", "--quiet"]) == 0
    assert run(["map", "add", path, str(part), "--plant", "part", "--quiet"]) == 0
    capsys.readouterr()
    assert run(["map", "add", path, str(today)]) == 0
    assert "fits part as well: it and whole may be one plant, or overlap" in capsys.readouterr().err
    assert run(["map", "undo", path, "--quiet"]) == 0
    assert run(["map", "add", path, str(today), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["plant"], told["also_fits"]) == ("whole", ["part"])


def test_reading_a_result_needs_a_result(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="missing"):
        read_incoming(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError):
        read_incoming(tmp_path / "empty")
