"""Localisation of a session in a map, to be read like the method section of a paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import pairwise
from time import perf_counter

import numpy as np

from cluster_slam.config import LocaliseConfig
from cluster_slam.localisation import Landmarks, Localisation, Localiser
from cluster_slam.records import CLUTTER, IntArray, PlantMap, PoseHypotheses, Session, SessionLocalisation

Progress = Callable[[str, float], None]


def localise(
    session: Session,
    plants: Sequence[PlantMap | Landmarks],
    *,
    config: LocaliseConfig | None = None,
    independent: bool = False,
    progress: Progress | None = None,
) -> SessionLocalisation:
    """Where the frames of a session are in a map.

    Parameters
    ----------
    session : as ``open_session`` reads it. Of its poses the motion from frame to frame is used, never where they are.
    plants : of the map; where the session names one of them, only that is looked at.
    config : the options, defaults where None.
    independent : every frame is kidnapped; poses are not used at all.
    progress : called with the stage in words and a fraction 0..1.

    Raises
    ------
    InputError
        The map is empty.
    """
    config = config or LocaliseConfig()
    say = progress or (lambda _stage, _fraction: None)
    begin = perf_counter()
    say("reading the map", 0.0)
    sigma = (
        float(np.sqrt(np.trace(session.observations.covs, axis1=1, axis2=2).mean() / 3.0))
        if len(session.observations)
        else 0.005
    )
    localiser = Localiser(_asked(session, plants), config, time=float(session.stamps[0]), point_sigma_m=sigma)
    ready = perf_counter()
    rows = _rows_of_frames(session)
    found = []
    for i, here in enumerate(rows):
        say("localising", 0.05 + 0.95 * i / len(rows))
        found.append(localiser.locate_points(session.observations.points[here], session.observations.covs[here]))
    timings = {"map": ready - begin, "localising": perf_counter() - ready}
    return _session_localisation(session, rows, found, config, timings)


def _asked(session: Session, plants: Sequence[PlantMap | Landmarks]) -> Sequence[PlantMap | Landmarks]:
    """The plant that the session names, where the map has it; else all."""
    named = [p for p in plants if (p.plant if isinstance(p, Landmarks) else p.name) == session.plant]
    return named or plants


def _rows_of_frames(session: Session) -> list[IntArray]:
    """Rows of the observations of each frame, in their order."""
    frame = session.observations.frame
    order = np.argsort(frame, kind="stable")
    ends = np.searchsorted(frame[order], np.arange(session.n_frames + 1))
    return [order[a:b] for a, b in pairwise(ends.tolist())]


def _session_localisation(
    session: Session,
    rows: list[IntArray],
    found: list[Localisation],
    config: LocaliseConfig,
    timings: dict[str, float],
) -> SessionLocalisation:
    n = session.n_frames
    T, covs = np.full((n, 4, 4), np.nan), np.full((n, 6, 6), np.nan)
    flowers, clusters = (np.full(len(session.observations), CLUTTER) for _ in range(2))
    for i, here in enumerate(found):
        if here.is_located:
            T[i], covs[i] = here.T_map_camera, here.cov
            flowers[rows[i]], clusters[rows[i]] = here.flower_ids, here.cluster_ids
    warnings = () if any(f.is_located for f in found) else ("no frame was located",)
    return SessionLocalisation(
        session=session,
        reasons=tuple(f.reason for f in found),
        plants=tuple(f.plant for f in found),
        n_inliers=np.array([len(f.hypotheses[0].fit.rows) if f.hypotheses else 0 for f in found], dtype=np.int64),
        probability=np.array([f.probability for f in found]),
        T_map_camera=T,
        covs=covs,
        flower_ids=flowers,
        cluster_ids=clusters,
        hypotheses=_hypotheses(found),
        config=asdict(config),
        timings_s=timings,
        warnings=(*session.warnings, *warnings),
        status="poor" if warnings else "ok",
    )


def _hypotheses(found: list[Localisation]) -> PoseHypotheses:
    """Those of the frames that have more than one."""
    several = [(i, f) for i, f in enumerate(found) if len(f.hypotheses) > 1]
    each = [(i, k + 1, h.probability, h.fit.T_map_camera) for i, f in several for k, h in enumerate(f.hypotheses)]
    return PoseHypotheses(
        frame=np.array([e[0] for e in each], dtype=np.int64),
        rank=np.array([e[1] for e in each], dtype=np.int64),
        probability=np.array([e[2] for e in each], dtype=float),
        T_map_camera=np.array([e[3] for e in each], dtype=float).reshape(-1, 4, 4),
    )
