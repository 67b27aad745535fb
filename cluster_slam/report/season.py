"""The season report: one page with a slider over dates, that holds all it needs and asks nothing of the network."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.geometry import inverse, skew, transform
from cluster_slam.io.map.ledger import Event, events, state_of
from cluster_slam.io.map.store import MapStore, StoredSession
from cluster_slam.io.map.times import iso
from cluster_slam.records import PlantMap
from cluster_slam.remember.judge import Verdict, judge

DAY_S = 86400.0
_DIGITS = 5


def render_season(store: MapStore, plant: str | None = None, truth: Sequence[Path] = ()) -> str:
    """The page of a map, of one plant or of all, as one HTML text.

    Parameters
    ----------
    truth
        The results of all sessions of the map, where these have truth: the page then says how good the map is.

    Raises
    ------
    InputError
        There is no plant of this name, or a session without truth among those with it.
    """
    names = store.plant_names() if plant is None else [store.plant(plant).name]
    judged = [asdict(verdict) | _rates(verdict) for verdict in judge(store, truth)] if truth else []
    data = {"map": store.path.name, "plants": [_plant(store, name) for name in names], "judged": judged}
    asset = resources.files("cluster_slam.report").joinpath("assets")
    parts = {
        "title": html.escape(f"{store.path.name}: season"),
        "style": asset.joinpath("style.css").read_text("utf-8"),
        "script": asset.joinpath("season.js").read_text("utf-8"),
        "data": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("</", "<\\/"),
    }
    page = asset.joinpath("season.html").read_text("utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], page)


def _rates(verdict: Verdict) -> dict[str, float]:
    return {"f1": verdict.confusion.f1, "wrong_share": verdict.confusion.wrong_share}


def _plant(store: MapStore, name: str) -> dict[str, Any]:
    """All that the page shows of one plant."""
    plant, sessions = store.plant(name), store.sessions(name)
    ledger: dict[int, list[Event]] = {}
    for event in events(store):
        ledger.setdefault(event.cluster, []).append(event)
    return {
        "name": name,
        "drift_mm_per_day": round(1e3 * plant.drift_rate, 2),
        "sessions": [_session(store, session) for session in sessions],
        "clusters": _clusters(store, plant, sessions, ledger),
        "flowers": _flowers(store, plant, sessions),
    }


def _session(store: MapStore, session: StoredSession) -> dict[str, Any]:
    seen = store.read("SELECT x, y, z FROM observations WHERE session_id = ? AND x IS NOT NULL", (session.id,))
    after = np.array(seen, dtype=float).reshape(-1, 3)
    before = transform(inverse(session.T_map_world), after)
    middle = before.mean(axis=0) if len(before) else np.zeros(3)
    lever = np.vstack([np.eye(6)[:3], np.hstack([-skew(middle), np.eye(3)])])  # the pose at the plant's middle
    sigma = np.sqrt(np.maximum(np.diag(lever @ session.cov @ lever.T), 0.0))
    return {
        "id": session.session,
        "date": iso(session.start),
        "probability": round(session.probability, 4),
        "turn_deg": round(float(np.degrees(sigma[:3].max())), 2),
        "shift_mm": round(float(1e3 * sigma[3:].max()), 1),
        "scale": round(session.scale, 4),
        "before": before.round(_DIGITS).tolist(),
        "after": after.round(_DIGITS).tolist(),
    }


def _clusters(
    store: MapStore, plant: PlantMap, sessions: list[StoredSession], ledger: dict[int, list[Event]]
) -> list[dict[str, Any]]:
    lives: dict[int, list[Any]] = {i: [None] * len(sessions) for i in plant.cluster_ids.tolist()}
    for k, session in enumerate(sessions):
        rows = store.read(
            "SELECT cluster_id, x, y, z, n_flowers, probability, is_new FROM observations WHERE session_id = ?",
            (session.id,),
        )
        for i, x, y, z, n, probability, is_new in rows:
            lives[i][k] = (
                0 if x is None else [round(v, _DIGITS) for v in (x, y, z)] + [n, round(probability, 3), is_new]
            )
    out = []
    for k, i in enumerate(plant.cluster_ids.tolist()):
        presence = float(plant.cluster_presence[k])
        out.append(
            {
                "id": i,
                "life": lives[i],
                "velocity": (1e3 * DAY_S * plant.velocities[k]).round(2).tolist(),
                "sigma_mm": round(float(1e3 * np.sqrt(np.trace(plant.cluster_covs[k]) / 3.0)), 2),
                "n_flowers": int(plant.n_flowers[k]),
                "presence": round(presence, 3),
                "state": state_of(presence),
                "events": [{"kind": e.kind, "date": iso(e.time), "note": e.note} for e in ledger.get(i, [])],
            }
        )
    return out


def _flowers(store: MapStore, plant: PlantMap, sessions: list[StoredSession]) -> list[dict[str, Any]]:
    lives: dict[int, list[Any]] = {i: [None] * len(sessions) for i in plant.flower_ids.tolist()}
    for k, session in enumerate(sessions):
        for i, x, y, z in store.read(
            "SELECT flower_id, x, y, z FROM flower_observations WHERE session_id = ?", (session.id,)
        ):
            lives[i][k] = [round(v, _DIGITS) for v in (x, y, z)]
    return [
        {"id": i, "cluster": c, "life": lives[i], "presence": round(p, 3)}
        for i, c, p in zip(
            plant.flower_ids.tolist(), plant.flower_cluster_ids.tolist(), plant.flower_presence.tolist(), strict=True
        )
    ]
