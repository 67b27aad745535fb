"""``cluster-slam check``: read a session and say what is in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from cluster_slam.cli.detect import detector_for
from cluster_slam.cli.options import JsonOption, QuietOption, SessionArgument
from cluster_slam.cli.summary import print_json, print_table, print_warnings

if TYPE_CHECKING:
    from cluster_slam.records import Session, Truth


def command(
    session: SessionArgument,
    level: Annotated[
        int | None,
        typer.Option("--level", help="3 flowers, 2 detections, 1 pictures; default: the highest.", show_default=False),
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Read a session and say what is in it.

    Every value is checked; what looks odd but can be used is a warning.

    Example: cluster-slam check data/sample
    """
    from cluster_slam.io.session import open_session, open_truth

    opened = open_session(session, level=level, detector=detector_for(session, level, None, None))
    facts = session_facts(opened, open_truth(session, opened))
    if as_json:
        print_json({**facts, "warnings": list(opened.warnings)})
    elif not quiet:
        print_warnings(opened.warnings)
        print_table("cluster-slam check", [(name.replace("_", " "), str(value)) for name, value in facts.items()])
    return 0


def session_facts(session: Session, truth: Truth | None) -> dict[str, Any]:
    """What a session holds, by name."""
    import numpy as np

    seen = session.observations
    steps = np.diff(session.stamps)
    facts: dict[str, Any] = {
        "id": session.id,
        "plant": session.plant or "",
        "level": session.level,
        "frames": session.n_frames,
        "duration_s": round(float(session.stamps[-1] - session.stamps[0]), 3),
        "rate_hz": round(float(1 / np.median(steps)), 3) if len(steps) else 0.0,
        "poses": f"{session.pose_frame}, {session.pose_error}",
        "observations": len(seen),
        "observations_per_frame": round(len(seen) / session.n_frames, 3),
        "covariances": _covariances(session),
        "scores": "given" if np.isfinite(seen.scores).any() else "none",
    }
    if len(seen):
        ranges = np.linalg.norm(seen.points, axis=1)
        facts["distance_m"] = " to ".join(f"{x:.3g}" for x in np.quantile(ranges, [0.0, 1.0]))
        sigma = np.sqrt(np.trace(seen.covs, axis1=1, axis2=2) / 3)
        facts["median_sigma_m"] = float(f"{np.median(sigma):.3g}")
    return {**facts, "truth": ", ".join(truth_parts(truth)) or "none"}


def _covariances(session: Session) -> str:
    if session.level == 2:
        return "from the stated noise of pixel and depth"
    return "given" if session.observations.has_covariance else "from the stated sigma"


def truth_parts(truth: Truth | None) -> list[str]:
    """What is known of the truth, in words."""
    if truth is None:
        return []
    parts = {
        "poses": truth.T_world_camera,
        "identities": truth.flower_ids,
        "positions at rest": truth.rest_positions,
        "frame of the map": truth.T_map_world,
    }
    return [name for name, value in parts.items() if value is not None]
