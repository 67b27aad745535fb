"""Lengths that look as if they were not in metres: named in warnings, never changed."""

from __future__ import annotations

import numpy as np

from cluster_slam.records import Session

FAR = 100.0  # m; a camera sees no flower so far away
RANGE_TO_SIGMA = (2.0, 2e4)  # medians; 5 m at 0.3 mm is 1.7e4; a thousandfold error leaves this band
TRAVEL_TO_RANGE = 100.0  # a millimetre trajectory is a thousand times too long
HAND_EYE = 5.0  # m; no flange carries its camera farther away


def unit_warnings(session: Session) -> tuple[str, ...]:
    """What suggests millimetres where metres are expected, or points that are not in the optical frame."""
    return (*_flowers(session), *_poses(session), *_hand_eye(session))


def _flowers(session: Session) -> list[str]:
    seen = session.observations
    if not len(seen):
        return []
    where = "detections.csv" if session.level == 2 else "flowers.csv"
    ranges = float(np.median(np.linalg.norm(seen.points, axis=1)))
    sigma = float(np.median(np.sqrt(np.trace(seen.covs, axis1=1, axis2=2) / 3)))
    found = []
    low, high = RANGE_TO_SIGMA
    if ranges > FAR:
        found.append(f"{where}: median distance {ranges:.4g} m, expected metres: are these millimetres?")
    elif not low * sigma < ranges < high * sigma:
        text = f"median distance {ranges:.4g} m with a median sigma of {sigma:.3g} m"
        found.append(f"{where}: {text}, expected metres in both: is one in millimetres?")
    if np.median(seen.points[:, 2]) < 0:
        found.append(f"{where}: most z are negative, expected the optical frame (z forward)")
    return found


def _poses(session: Session) -> list[str]:
    seen = session.observations
    positions = session.poses[:, :3, 3]
    travel = float(np.ptp(positions, axis=0).max())
    ranges = float(np.median(np.linalg.norm(seen.points, axis=1))) if len(seen) else np.inf
    if travel > FAR and travel > TRAVEL_TO_RANGE * ranges:
        return [
            f"poses.txt: the camera travels {travel:.4g} m past flowers {ranges:.3g} m away: are these millimetres?"
        ]
    return []


def _hand_eye(session: Session) -> list[str]:
    if session.T_flange_camera is None:
        return []
    length = float(np.linalg.norm(session.T_flange_camera[:3, 3]))
    if length < HAND_EYE:
        return []
    return [f"session.toml: T_flange_camera is {length:.4g} m long, expected metres: are these millimetres?"]
