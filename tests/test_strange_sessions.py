"""The whole command on sessions with next to nothing in them: a result in the format, poor where nothing was found."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from folders import TOML, write_folder
from result_format import check_result_folder

from cluster_slam import evaluate, smooth
from cluster_slam.cli.app import run
from cluster_slam.geometry import Array, transform
from cluster_slam.records import StatedNoise
from cluster_slam.simulate import PRESETS, simulate_session

N_FRAMES = 40
KINDS = {
    "camera": TOML,
    "flange": TOML.replace('"T_world_camera"', '"T_world_flange"\nT_flange_camera = [0, 0, 0.05, 0, 0, 0, 1]'),
    "odometry": TOML.replace('"T_world_camera"', '"T_world_camera"\npose_error = "odometry"'),
}
PLACES = np.array([[0.1, 0.0, 0.6], [0.13, 0.02, 0.62], [0.08, 0.03, 0.58]])  # m, from the first camera


@dataclass(frozen=True, eq=False)
class Strange:
    """Frames that move sideways by ``step`` and flowers that they see."""

    frame: np.ndarray  # (m,)
    points: Array  # (m, 3)
    n_frames: int = N_FRAMES
    step: float = 0.01  # m a frame


def seen(flowers: int, frames: int = N_FRAMES, times: int = 1, n_frames: int = N_FRAMES, step: float = 0.01) -> Strange:
    """``flowers`` flowers in the first ``frames`` frames, each ``times`` times in a frame."""
    frame, flower, _ = (a.ravel() for a in np.indices((frames, flowers, times)))
    noise = np.random.default_rng(0).normal(0, 0.002, (len(frame), 3))
    moved = step * frame[:, None] * np.array([1.0, 0.0, 0.0])
    return Strange(frame, PLACES[flower] - moved + noise, n_frames, step)


def clutter() -> Strange:
    """Four detections a frame, all over the place."""
    points = np.random.default_rng(1).uniform([-0.4, -0.3, 0.4], [0.4, 0.3, 1.0], (4 * N_FRAMES, 3))
    return Strange(np.repeat(np.arange(N_FRAMES), 4), points)


STRANGE = {
    "one frame": seen(3, frames=1, n_frames=1),
    "one frame, one flower": seen(1, frames=1, n_frames=1),
    "two frames": seen(3, frames=2, n_frames=2),
    "one flower": seen(1),
    "each flower twice": seen(3, times=2),
    "a camera that stands still": seen(3, step=0.0),
    "three flowers": seen(3),
}
NOTHING = {
    "no flowers": seen(0),
    "one frame, no flowers": seen(0, n_frames=1),
    "all clutter": clutter(),
}


def write(folder: Path, toml: str, strange: Strange, backwards: bool = False) -> Path:
    stamps = [f"{100 + i / 10:.6f}" for i in range(strange.n_frames)]
    poses = "".join(f"{t} {strange.step * i:.6f} 0 0 0 0 0 1\n" for i, t in enumerate(stamps))
    rows = [
        f"{stamps[i]},{x:.6f},{y:.6f},{z:.6f}\n" for i, (x, y, z) in zip(strange.frame, strange.points, strict=True)
    ]
    table = "timestamp,x,y,z\n" + "".join(reversed(rows) if backwards else rows)
    return write_folder(folder, {"session.toml": toml, "poses.txt": poses, "flowers.csv": table})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", STRANGE)
def test_a_strange_session_gives_a_result(tmp_path: Path, name: str, kind: str) -> None:
    session = write(tmp_path / "session", KINDS[kind], STRANGE[name])
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), "--quiet"]) in (0, 1)
    check_result_folder(tmp_path / "out", session)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NOTHING)
def test_a_session_with_nothing_in_it_gives_a_poor_result(
    tmp_path: Path, name: str, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    session = write(tmp_path / "session", KINDS[kind], NOTHING[name])
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), "--quiet"]) == 1
    assert capsys.readouterr().err.startswith("warning: the result is poor: ")
    check_result_folder(tmp_path / "out", session)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["status"] == "poor"


@pytest.mark.parametrize("kind", KINDS)
def test_the_order_of_the_rows_does_not_matter(tmp_path: Path, kind: str) -> None:
    """Backwards: the same clusters, and each row with its own flower."""
    ids = []
    for backwards in (False, True):
        session = write(tmp_path / f"s{backwards}", KINDS[kind], STRANGE["three flowers"], backwards)
        out = tmp_path / f"o{backwards}"
        assert run(["smooth", str(session), "-o", str(out), "--quiet"]) == 0
        check_result_folder(out, session)
        lines = (out / "observations.csv").read_text().splitlines()[1:]
        ids.append([line.split(",")[1] for line in lines])
    pairs = set(zip(ids[0], reversed(ids[1]), strict=True))
    assert len(pairs) == len(set(ids[0]))


def test_copies_of_one_frame_stand_where_they_were_seen() -> None:
    """An arm that stands still and points that repeat to the last digit: nothing has an error to be estimated from."""
    session = simulate_session(PRESETS["sample"], seed=3).session
    given = session.observations
    first, n = given.frame == 0, 60
    copies = replace(
        given,
        frame=np.repeat(np.arange(n), int(first.sum())),
        points=np.tile(given.points[first], (n, 1)),
        covs=np.tile(given.covs[first], (n, 1, 1)),
        scores=np.tile(given.scores[first], n),
    )
    still = replace(
        session, stamps=session.stamps[:n], poses=np.tile(session.poses[:1], (n, 1, 1)), observations=copies
    )
    result = smooth(still)
    assert len(result.flowers) == int(first.sum())
    seen = transform(still.T_world_camera[0], given.points[first])
    of = result.flower_ids.reshape(n, -1)
    assert (of == of[0]).all()
    places = result.flowers.positions[np.searchsorted(result.flowers.ids, of[0])]
    assert np.abs(places - seen).max() < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_in_one_frame_every_observation_stands(seed: int) -> None:
    """Forty detections, some of them a millimetre apart: nothing can be confirmed, so nothing is rejected."""
    made = simulate_session(
        replace(PRESETS["moderate"], duration_s=0.05, clutter_per_frame=12.0, miss_rate=0.0), seed=seed
    )
    observations = made.session.observations
    first = np.flatnonzero(observations.frame == 0)
    twice = np.concatenate([first, first[:5]])
    points = observations.points[twice]
    points[len(first) :] += 0.001
    one = replace(
        made.session,
        stamps=made.session.stamps[:1],
        poses=made.session.poses[:1],
        observations=replace(
            observations,
            frame=observations.frame[twice],
            points=points,
            covs=observations.covs[twice],
            scores=observations.scores[twice],
        ),
    )
    result = smooth(one)
    assert (result.flower_ids >= 0).all()
    assert len(np.unique(result.flower_ids)) == len(twice)
    assert set(result.clusters.states) == {"confirmed"}


def test_in_half_a_second_what_was_seen_three_times_stands() -> None:
    """Thirty frames: a few sights of a flower confirm it, as false detections do not meet by chance so often."""
    world = replace(PRESETS["sample"], duration_s=1.0, fps=30.0, clutter_per_frame=0.5, clutter_persistent_share=0.0)
    made = simulate_session(world, seed=4)
    result = smooth(made.session)
    true = made.truth.flower_ids
    assert true is not None
    ids, count = np.unique(true[true >= 0], return_counts=True)
    often = np.isin(true, ids[count >= 4])
    assert (result.flower_ids[often] >= 0).mean() > 0.98
    assert (result.flower_ids[true < 0] >= 0).mean() < 0.1


def test_a_session_without_any_error_is_smoothed() -> None:
    """Made by arithmetic, as a first user's test may be: no residual is left to say how large errors are."""
    still = {"sway_m": 0.0, "ambient_sway_m": 0.0, "hand_eye_translation": 0.0, "hand_eye_rotation": 0.0}
    sharp = {"pixel_sigma": 0.0, "depth_sigma": 0.0, "pose_translation": 0.0, "pose_rotation": 0.0}
    world = replace(PRESETS["sample"], duration_s=4.0, with_covariances=False, clutter_per_frame=0.0, **still, **sharp)
    made = simulate_session(world, seed=5)
    result = smooth(replace(made.session, noise=StatedNoise()))
    metrics = evaluate(result, made.session, made.truth)
    assert (metrics.flower_idf1 or 0.0) > 0.99
    assert (metrics.flower_rmse_m or 1.0) < 1e-4
