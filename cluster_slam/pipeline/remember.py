"""Putting a session into a map, to be read like the method section of a paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.growth import memory_days
from cluster_slam.constellation.identify import Identities, identify, nobody
from cluster_slam.constellation.match import Found
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.io.map.incoming import Incoming
from cluster_slam.io.map.store import MapStore, StoredSession
from cluster_slam.io.map.times import iso
from cluster_slam.io.map.write import Entry, next_ids, put
from cluster_slam.records import Constellation, PlantMap
from cluster_slam.remember.decide import Decision, Refusal, decide
from cluster_slam.remember.gauge import frame_covariance
from cluster_slam.remember.looked import looked_at
from cluster_slam.remember.tables import aligned, empty_plant
from cluster_slam.remember.update import update

Progress = Callable[[str, float], None]
FAR_M = 100.0  # no plant is so large


@dataclass(frozen=True, slots=True, eq=False)
class Added:
    """What came of adding a session to a map."""

    session: StoredSession | None  # None: refused, the map is as it was
    decision: Decision
    n_known: int = 0  # clusters that the map had
    n_new: int = 0
    n_missed: int = 0  # clusters that were looked at and not seen
    n_flowers_known: int = 0
    n_flowers_new: int = 0
    also_fits: tuple[str, ...] = ()  # other plants of the map that show the same flowers


def add(
    store: MapStore,
    incoming: Incoming,
    *,
    plant: str | None = None,
    new_plant: bool = False,
    any_plant: bool = False,
    similarity: bool = False,
    config: MapConfig | None = None,
    progress: Progress | None = None,
) -> Added:
    """Align a session with a plant of the map, say who is who, and store it: in one transaction.

    Parameters
    ----------
    plant
        Name of the plant; None: as the session names it, else all plants are tried.
    new_plant
        What fits no plant founds a new one.
    any_plant
        Whatever name the session gives, try all plants.
    similarity
        The session's unit of length may differ from the map's (positions that come from pictures).

    Raises
    ------
    InputError
        The session is in the map already, or has no flowers.
    OutputError
        The map cannot be written.
    """
    config = config or MapConfig()
    session = incoming.constellation
    with store.write() as connection:
        _check_new(store, incoming)
        _check_unit(session)
        name = plant or (None if any_plant else session.plant)
        known = store.plant_names()
        tried = [name] if name in known else ([] if name is not None else known)
        plants = [store.plant(n, with_sightings=False) for n in tried]
        decision = decide(session, plants, config, similarity=similarity, progress=progress)
        match = decision.accepted
        if match is not None and match.found is not None:
            _check_order(store, session, match.name)
            entry = _known(store, incoming, match.found, decision, config)
        elif not plants or (new_plant and name is None and decision.refusal is not Refusal.AMBIGUOUS):
            entry = _first(store, incoming, name or _free_name(session, known), config)
        else:
            return Added(None, decision)
        put(connection, entry)
    stored = store.sessions(entry.plant.name)[-1]
    new, fresh = int(entry.cluster_is_new.sum()), int(entry.flower_is_new.sum())
    counts = (len(entry.cluster_is_new) - new, new, len(entry.missed), len(entry.flower_is_new) - fresh, fresh)
    return Added(stored, decision, *counts, tuple(n for n in decision.fits if n != entry.plant.name))


def _check_new(store: MapStore, incoming: Incoming) -> None:
    session = incoming.constellation
    if not len(session.flowers):
        raise InputError(f"{session.session}: has no flowers, expected some to remember")
    for other in store.sessions():
        if other.session == session.session:
            same = "the same" if other.digest == incoming.digest else "another"
            text = f"{store.path}: session {session.session!r} is in the map already ({same} result of it)"
            raise InputError(f"{text}, expected each once; `map undo` takes out the latest")


def _check_unit(session: Constellation) -> None:
    spread = float(np.sqrt(((session.flowers - session.flowers.mean(axis=0)) ** 2).sum(1).mean()))
    if spread > FAR_M:
        text = f"{session.session}: its flowers spread over {spread:.4g} m (RMS)"
        raise InputError(f"{text}, expected one plant in metres: are these millimetres?")


def _check_order(store: MapStore, session: Constellation, plant: str) -> None:
    latest = store.plant(plant).last_session
    if session.end < latest:
        text = f"{session.session}: its last frame is of {iso(session.end)}, but {plant} has a session of {iso(latest)}"
        raise InputError(f"{text}, expected sessions in the order of time; `map undo` takes out the latest")


def _free_name(session: Constellation, known: list[str]) -> str:
    """A name for a plant that nobody named."""
    k = len(known) + 1
    while f"plant-{k}" in known:
        k += 1
    return f"plant-{k}"


def _first(store: MapStore, incoming: Incoming, name: str, config: MapConfig) -> Entry:
    """The session founds a plant: its world is the plant's frame."""
    plant = empty_plant(name, config.growth)
    cov = 1e-12 * np.eye(6)
    return _entry(store, incoming, plant, np.eye(4), 1.0, cov, nobody(incoming.constellation), np.nan, 1.0, config)


def _known(store: MapStore, incoming: Incoming, found: Found, decision: Decision, config: MapConfig) -> Entry:
    """The session shows a plant that the map has."""
    plant = store.plant(found.plant.name, with_sightings=False)
    who = identify(incoming.constellation, found, decision.probability)
    rows = np.searchsorted(plant.flower_ids, found.plant.flower_ids)
    is_known = who.flower >= 0
    who = replace(who, flower=np.where(is_known, rows[np.where(is_known, who.flower, 0)], -1))
    evidence, T = decision.matches[0].evidence, found.T_map_world
    now, sessions = incoming.constellation.start, store.sessions(plant.name)
    low, high = found.scene.scale_range
    memory = memory_days(plant, config.growth)
    factor, with_scale = found.offset_factor, low < high
    cov = frame_covariance(
        found.pairs, found.scale, plant, sessions, now, memory, drift_factor=factor, with_scale=with_scale
    )
    return _entry(store, incoming, plant, T, found.scale, cov, who, evidence, decision.probability, config)


def _entry(
    store: MapStore,
    incoming: Incoming,
    plant: PlantMap,
    T_map_world: Array,
    scale: float,
    cov: Array,
    who: Identities,
    evidence: float,
    probability: float,
    config: MapConfig,
) -> Entry:
    session = incoming.constellation
    where = aligned(session, T_map_world, scale)
    world = transform(inverse(T_map_world), plant.flowers) / scale
    looked = looked_at(incoming.view, world, config.presence.min_views)
    after = update(plant, session, where, who, looked, config, *next_ids(store))
    return Entry(
        plant=after.plant,
        session=session,
        kind=incoming.kind,
        digest=incoming.digest,
        T_map_world=T_map_world,
        scale=scale,
        cov=cov,
        evidence=evidence,
        probability=probability,
        cluster_map_ids=after.cluster_map_ids,
        cluster_probability=who.cluster_probability,
        cluster_is_new=who.cluster < 0,
        flower_map_ids=after.flower_map_ids,
        flower_probability=who.flower_probability,
        flower_is_new=who.flower < 0,
        flowers=where.flowers,
        missed=after.missed,
        viewpoint=_viewpoint(plant, session, T_map_world, scale),
    )


def _viewpoint(plant: PlantMap, session: Constellation, T_map_world: Array, scale: float) -> Array | None:
    if session.viewpoint is None:
        return plant.viewpoint
    return transform(T_map_world, scale * session.viewpoint)


def match_all(
    store: MapStore,
    incoming: Incoming,
    *,
    similarity: bool = False,
    config: MapConfig | None = None,
    progress: Progress | None = None,
) -> Decision:
    """How well a session fits each plant of the map, best first; nothing is changed."""
    plants = store.plants(with_sightings=False)
    return decide(incoming.constellation, plants, config or MapConfig(), similarity=similarity, progress=progress)
