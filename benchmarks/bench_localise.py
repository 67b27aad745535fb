"""Where is the camera: a kidnapped frame, a tracked one, and a field of plants. Processor time.

Ratios do not depend on the machine: a map of 100 clusters over one of 20, and a field of 1,000 plants over one of 100
(10, if the cost grew with the map).
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
from figure import Figure

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from localisation_trials import Trial, kidnapped, map_of, plant_of
from localisation_windows import Window, window

from cluster_slam.localisation import Localiser
from cluster_slam.localisation.merging import merged_points
from cluster_slam.localisation.motion import motion_of
from cluster_slam.localisation.scene import ErrorScale, make_look
from cluster_slam.pipeline.localise import localise
from cluster_slam.records import Observations, Session
from cluster_slam.simulate import PRESETS, simulate_session

SEED = 7
N_FRAMES = 40


def measure(quick: bool) -> list[Figure]:
    """Milliseconds and ratios; ``quick``: no fields."""
    few, many = _kidnapped_ms(20), _kidnapped_ms(100)
    figures = [
        Figure("kidnapped frame, map of 20 clusters, median", few, "ms", 60.0),
        Figure("kidnapped frame, map of 100 clusters, median", many, "ms", 60.0),
        Figure("kidnapped frame, 100 clusters over 20", many / few, "times", 5.0),
        Figure("tracked frame, moderate", _tracked_ms(), "ms", 5.0),
    ]
    if quick:
        return figures
    small, large = _field_s(100), _field_s(1000)
    return [
        *figures,
        Figure("window in a field of 1,000 plants, median", large, "s", 5.0),
        Figure("window in a field, 1,000 plants over 100", large / small, "times", 5.0),
    ]


def _kidnapped_ms(n_clusters: int) -> float:
    plant = plant_of(SEED, n_clusters)
    localiser = Localiser(map_of(plant), point_sigma_m=0.002)
    localiser.index(0)
    scale = ErrorScale(sway_m=0.002 / np.sqrt(3.0))
    seconds = []
    for k in range(N_FRAMES):
        frame = kidnapped(plant, Trial(3 + k % 6), rng=np.random.default_rng([SEED, k]))
        begin = process_time()
        localiser.locate_points(frame.points, frame.covs, scale=scale)
        seconds.append(process_time() - begin)
    return 1e3 * float(np.median(seconds))


def _tracked_ms() -> float:
    """Of a frame, the kidnapped beginning and the learning of errors taken off by a shorter session."""
    made = simulate_session(PRESETS["moderate"], seed=SEED)
    marks = map_of(made.plant)
    n = made.session.n_frames
    seconds = []
    for part in (n // 3, n):
        session = _first(made.session, part)
        begin = process_time()
        localise(session, [marks])
        seconds.append(process_time() - begin)
    return 1e3 * (seconds[1] - seconds[0]) / (n - n // 3)


def _first(session: Session, n: int) -> Session:
    """The first frames of a session."""
    o, keep = session.observations, session.observations.frame < n
    seen = Observations(o.frame[keep], o.points[keep], o.covs[keep], o.scores[keep])
    return replace(session, stamps=session.stamps[:n], poses=session.poses[:n], observations=seen)


def _field_s(n_plants: int) -> float:
    plants = [plant_of(SEED * 1000 + k) for k in range(n_plants)]
    localiser = Localiser([map_of(p, str(k)) for k, p in enumerate(plants)], point_sigma_m=0.002)
    seconds = []
    for k in range(20):
        made = window(plants[k], Trial(6), rng=np.random.default_rng([SEED, k]), n_least=True)
        begin = process_time()
        _locate(localiser, made)
        seconds.append(process_time() - begin)
    return float(np.median(seconds))


def _locate(localiser: Localiser, made: Window) -> None:
    o, motion = made.session.observations, motion_of(made.session)
    last = made.session.n_frames - 1
    looks = [make_look(o.points[o.frame == k], o.covs[o.frame == k], localiser.errors) for k in range(last + 1)]
    steps = np.stack([motion.camera_step(last, k, None) for k in range(last + 1)])
    among = localiser.likely_plants(merged_points(looks, steps, localiser.errors.sway_m))
    localiser.locate_points(looks[-1].points, looks[-1].covs, among=among)
