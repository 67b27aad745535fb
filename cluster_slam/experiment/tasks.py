"""What is done in one cell: a world is simulated, a method runs, figures come out. Runs in any process."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np

from cluster_slam.errors import ClusterSlamError
from cluster_slam.experiment.plan import Cell, Resolved, resolve
from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.records import CLUTTER

Figures = dict[str, float]


def run_cell(cell: Cell) -> Figures:
    """The figures of one cell; ``seconds`` is of the processor. A world that cannot be has ``failed`` = 1."""
    begin = process_time()
    try:
        figures = _TASKS[cell.task](resolve(cell), cell.seed)
    except ClusterSlamError:
        figures = {"failed": 1.0}
    known = {name: value for name, value in figures.items() if np.isfinite(value)}
    return {**known, "seconds": process_time() - begin}


def _localise(options: Resolved, seed: int) -> Figures:
    from cluster_slam.localisation.landmarks import landmarks
    from cluster_slam.pipeline.localise import localise
    from cluster_slam.simulate import simulate_session

    made = simulate_session(options.simulate, seed=seed)
    plant = made.plant
    if options.task["wrong_map"]:
        plant = simulate_session(options.simulate, seed=seed + 1_000_000).plant
    rng = np.random.default_rng([seed, *b"age"])
    drift = float(options.task["map_drift_m_per_day"]) * float(options.task["map_age_days"]) / np.sqrt(3.0)
    moved = rng.normal(0.0, 1.0, plant.centroids.shape) * drift
    marks = landmarks(
        plant.flowers - moved[plant.flower_cluster],
        plant.flower_cluster,
        shared_covs=np.tile(drift**2 * np.eye(3), (len(plant.centroids), 1, 1)),
    )
    window = int(options.task["window"]) or None
    found = localise(
        made.session, [marks], config=options.method, independent=bool(options.task["independent"]), window=window
    )
    located = found.is_located
    figures = {"located": float(located.mean()), "ms_per_frame": 1e3 * found.timings_s["localising"] / len(located)}
    if options.task["wrong_map"]:
        return {**figures, "wrong_located": float(located.mean())}
    truth = made.truth
    if truth.T_world_camera is None or truth.flower_ids is None:
        return figures
    claimed = found.flower_ids != CLUTTER
    figures["identity_precision"] = _share(found.flower_ids[claimed] == truth.flower_ids[claimed])
    return {**figures, **pose_figures(found.T_map_camera[located], found.covs[located], truth.T_world_camera[located])}


def pose_figures(estimated: Array, covs: Array, true: Array) -> Figures:
    """Errors of poses (n, 4, 4), and whether their covariances (n, 6, 6) are true."""
    if not len(estimated):
        return {}
    xi = se3_log(inverse(estimated) @ true)
    turn, shift = np.linalg.norm(xi[:, :3], axis=1), np.linalg.norm(xi[:, 3:], axis=1)
    nees = np.einsum("ni,ni->n", xi, np.linalg.solve(covs, xi[..., None])[..., 0])
    return {
        "position_rmse_m": float(np.sqrt((shift**2).mean())),
        "rotation_rmse_rad": float(np.sqrt((turn**2).mean())),
        "within_1cm_1deg": _share((shift < 0.01) & (turn < np.pi / 180.0)),
        "nees_over_6": float(nees.mean() / 6.0),
    }


def _share(values: Array) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _smooth(options: Resolved, seed: int) -> Figures:
    from cluster_slam.evaluation import evaluate
    from cluster_slam.pipeline.smooth import smooth
    from cluster_slam.simulate import simulate_session

    made = simulate_session(options.simulate, seed=seed)
    result = smooth(made.session, config=options.method)
    return _numbers(evaluate(result, made.session, made.truth).as_json())


def _track(options: Resolved, seed: int) -> Figures:
    from cluster_slam.evaluation import evaluate
    from cluster_slam.pipeline.smooth import smooth
    from cluster_slam.pipeline.track import track
    from cluster_slam.simulate import simulate_session

    made = simulate_session(options.simulate, seed=seed)
    calibration = smooth(made.session).calibration if options.task["with_calibration"] else None
    result = track(made.session, calibration=calibration, config=options.method)
    return _numbers(evaluate(result, made.session, made.truth).as_json())


def _reidentify(options: Resolved, seed: int) -> Figures:
    """A season of sessions as a perfect smoothing would leave them, added to one map one after the other."""
    from cluster_slam.io.map import create_map
    from cluster_slam.io.map.incoming import Incoming
    from cluster_slam.pipeline.remember import add
    from cluster_slam.remember.score import Confusion, confusion
    from cluster_slam.simulate.season import SeasonPlant

    plant = SeasonPlant(options.season, seed=seed)
    clusters, flowers, n_refused = Confusion(), Confusion(), 0
    known: tuple[dict[int, int], dict[int, int]] = ({}, {})
    with tempfile.TemporaryDirectory() as folder, create_map(Path(folder) / "season.map") as store:
        for k, day in enumerate(options.season.day_list):
            plant.grow_to(day)
            rest = plant.rest()
            added = add(store, Incoming(rest.constellation, "result", str(k)), plant="plant", config=options.method)
            if added.session is None:
                n_refused += 1
                continue
            for table, column, true, names, kind in (
                ("observations", "cluster_id", rest.true_clusters, known[0], 0),
                ("flower_observations", "flower_id", rest.true_flowers, known[1], 1),
            ):
                rows = store.read(
                    f"SELECT local_id, {column}, is_new FROM {table} WHERE session_id = ? AND local_id IS NOT NULL",
                    (added.session.id,),
                )
                local, ids, new = (np.array([row[i] for row in rows], dtype=np.int64) for i in range(3))
                score = confusion(true[local], ids, new.astype(bool), names)
                if k > 0 and kind == 0:
                    clusters = clusters + score
                elif k > 0:
                    flowers = flowers + score
    return {
        "cluster_f1": clusters.f1,
        "flower_f1": flowers.f1,
        "wrong_share": clusters.wrong_share,
        "refused": float(n_refused),
    }


def _numbers(values: dict[str, float]) -> Figures:
    return {name: float(value) for name, value in values.items() if isinstance(value, int | float)}


_TASKS: dict[str, Callable[[Resolved, int], Figures]] = {
    "localise": _localise,
    "smooth": _smooth,
    "track": _track,
    "reidentify": _reidentify,
}
