"""What a calibration found, what that is worth, and which motions would make it surer."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from cluster_slam.geometry import Array, inverse, so3_log
from cluster_slam.graph.calibration import Mounting
from cluster_slam.graph.noise import pose_model
from cluster_slam.records import Session

_POOR_SHIFT_M = 0.005  # a direction of the shift that is known no better is worth a word ...
_POOR_TURN_RAD = 0.009  # ... and so is a turn
STILL_RAD = 0.03  # root mean square turn below which the flange has not turned about an axis
_LITTLE_LEARNT = 0.5  # of the variance before, in the direction that was learnt least: if more is left, and motions
# are missing or a direction is known poorly, the whole is poor
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationReport:
    """What was found, how sure it is, and what would make it surer."""

    session: Session
    mounting: Mounting
    excitation_rad: Array  # (3,) root mean square turn about each axis of the flange
    advice: tuple[str, ...]
    unobserved: tuple[str, ...]
    source: Literal["flowers", "board"]
    n_used: int
    with_time: bool = False
    with_scale: bool = False
    warnings: tuple[str, ...] = ()
    status: Literal["ok", "poor"] = "ok"
    timings_s: dict[str, float] = field(default_factory=dict)


def report_on(
    session: Session,
    mounting: Mounting,
    n_used: int,
    unobserved: tuple[str, ...],
    source: Literal["flowers", "board"],
    with_time: bool,
    with_scale: bool,
) -> CalibrationReport:
    """What was found with what it is worth, and advice."""
    excitation = excitation_of(session)
    advice = _advice(mounting.cov[:6, :6], excitation)
    left = _left_to_learn(mounting.cov[:6, :6], pose_model(session).cov_hand_eye)
    still = bool((excitation < STILL_RAD).all())
    warnings = list(session.warnings)
    status: Literal["ok", "poor"] = "ok"
    if still or (left > _LITTLE_LEARNT and advice) or len(unobserved) >= 3:
        status = "poor"
        warnings.append("the motions do not tell all of the mounting" + ("; the arm did not turn" if still else ""))
    return CalibrationReport(
        session,
        mounting,
        excitation,
        advice,
        unobserved,
        source,
        n_used,
        with_time,
        with_scale,
        tuple(warnings),
        status,
    )


def _left_to_learn(cov: Array, prior: Array) -> float:
    """Share of the variance before, that is left in the direction in which least was learnt (largest eigenvalue)."""
    L = np.linalg.cholesky(prior)
    half = np.linalg.solve(L, cov)
    return float(np.linalg.eigvalsh(np.linalg.solve(L, half.T))[-1])


def excitation_of(session: Session) -> Array:
    """Root mean square turn (3,) about each axis of the flange, rad."""
    turns = so3_log(inverse(session.poses[:1])[:, :3, :3] @ session.poses[:, :3, :3])
    out: Array = turns.std(0)
    return out


def _advice(cov: Array, excitation: Array) -> tuple[str, ...]:
    """Which motions are missing, in words."""
    words = []
    for a in np.flatnonzero(excitation < STILL_RAD).tolist():
        turned = np.degrees(excitation[a])
        words.append(f"turn the flange about its {_AXES[a]} axis by 20 degrees or more (so far {turned:.1f} RMS)")
    shifts, axes = np.linalg.eigh(cov[3:, 3:])
    for value, axis in zip(shifts, axes.T, strict=True):
        if np.sqrt(value) > _POOR_SHIFT_M:
            known = f"the camera's place along {_named(axis)} is known to {1e3 * np.sqrt(value):.1f} mm only"
            words.append(f"{known}: turn about axes across it")
    turns, axes = np.linalg.eigh(cov[:3, :3])
    for value, axis in zip(turns, axes.T, strict=True):
        if np.sqrt(value) > _POOR_TURN_RAD:
            words.append(
                f"the camera's turn about {_named(axis)} is known to {np.degrees(np.sqrt(value)):.2f} degrees only: "
                "turn and move more, and look at flowers farther apart"
            )
    return tuple(words)


def _named(axis: Array) -> str:
    """A direction by the axes of the camera."""
    parts = [f"{abs(v):.1f} {n}" for v, n in zip(axis.tolist(), _AXES, strict=True) if abs(v) > 0.3]
    return "the camera's " + (_AXES[int(np.abs(axis).argmax())] if np.abs(axis).max() > 0.9 else " + ".join(parts))
