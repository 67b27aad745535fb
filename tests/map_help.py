"""Small plants of a season as a map takes them in, without smoothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from cluster_slam.geometry import tum_from_pose
from cluster_slam.io.map import create_map
from cluster_slam.io.map.incoming import Incoming
from cluster_slam.io.map.store import MapStore
from cluster_slam.pipeline.remember import add
from cluster_slam.records import Constellation
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.season import SEASON, SeasonPlant

SMALL = replace(SEASON, session=SimulateConfig(n_clusters=7, loose_share=0.0, plant_width_m=1.2))
_COV = "cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
_UPPER = np.triu_indices(3)


def rest_incoming(plant: SeasonPlant) -> Incoming:
    """Today's session, the same each time it is asked for."""
    state = plant.rng.bit_generator.state
    rest = plant.rest()
    plant.rng.bit_generator.state = state
    return Incoming(rest.constellation, "result", f"{plant.seed}-{plant.day}")


def map_of(folder: Path, plant: SeasonPlant, name: str = "row3") -> MapStore:
    """A map of one plant's session of today."""
    store = create_map(folder / f"{name}.map")
    add(store, rest_incoming(plant), plant=name)
    return store


def landmark_file(path: Path, plant: SeasonPlant) -> Path:
    """Today's flowers as a table of landmarks."""
    rows = [
        f"{i},{c},{x:.9f},{y:.9f},{z:.9f}"
        for i, c, (x, y, z) in zip(plant.ids.tolist(), plant.cluster.tolist(), plant.flowers.tolist(), strict=True)
    ]
    path.write_text("\n".join(["flower_id,cluster_id,x,y,z", *rows, ""]))
    return path


def result_of(folder: Path, plant: SeasonPlant) -> Path:
    """Today's session as a result folder."""
    session = rest_incoming(plant).constellation
    folder.mkdir()
    stamps = [session.start, session.end]
    poses = [f"{t:.6f} " + " ".join(f"{v:.9f}" for v in tum_from_pose(np.eye(4))) for t in stamps]
    (folder / "trajectory.txt").write_text("\n".join([*poses, ""]))
    (folder / "flowers.csv").write_text(_flowers(session))
    (folder / "clusters.csv").write_text(_clusters(session))
    seen = [f"{session.start:.6f},{i},0" for i in session.flower_ids.tolist()]
    (folder / "observations.csv").write_text("\n".join(["timestamp,flower_id,cluster_id", *seen, ""]))
    run = {"version": "0", "command": "smooth", "session": session.session, "config": {}, "seed": 0}
    run |= {"timings_s": {}, "counts": {}, "warnings": [], "merged": [], "status": "ok"}
    (folder / "run.json").write_text(json.dumps(run))
    return folder


def _flowers(session: Constellation) -> str:
    covs = session.flower_covs[:, _UPPER[0], _UPPER[1]]
    rows = [
        ",".join([str(i), str(c), *(f"{v:.9e}" for v in (*p, *s)), f"{session.start:.6f}", f"{session.end:.6f}", "30"])
        for i, c, p, s in zip(
            session.flower_ids, session.flower_cluster_ids, session.flowers.tolist(), covs.tolist(), strict=True
        )
    ]
    header = f"flower_id,cluster_id,x,y,z,{_COV},first_seen,last_seen,n_observations"
    return "\n".join([header, *rows, ""])


def _clusters(session: Constellation) -> str:
    rows = [f"{i},{p[0]:.9f},{p[1]:.9f},{p[2]:.9f}" for i, p in zip(session.cluster_ids, session.clusters, strict=True)]
    return "\n".join(["cluster_id,x,y,z", *rows, ""])
