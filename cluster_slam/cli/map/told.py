"""What ``map add`` says about a session that was added, or was there already."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cluster_slam.cli.map.options import print_columns
from cluster_slam.cli.summary import print_json

if TYPE_CHECKING:
    from cluster_slam.io.map.incoming import Incoming
    from cluster_slam.io.map.store import StoredSession
    from cluster_slam.pipeline.remember import Added


def tell_completed(session: StoredSession, *, quiet: bool, as_json: bool) -> int:
    if as_json:
        print_json({"aligned": True, "plant": session.plant, "session": session.session, "was_in_map": True})
    elif not quiet:
        rows = [("session", f"{session.session} is in the map already; its result is complete now")]
        print_columns("cluster-slam map add", (), rows)
    return 0


def added_json(added: Added) -> dict[str, object]:
    if added.session is None:
        return {"aligned": False, "reason": added.decision.reason, "refusal": added.decision.refusal.value}
    from cluster_slam.geometry import tum_from_pose

    return {
        "aligned": True,
        "plant": added.session.plant,
        "session": added.session.session,
        "probability": added.session.probability,
        "T_map_world": tum_from_pose(added.session.T_map_world).tolist(),
        "clusters": {"known": added.n_known, "new": added.n_new, "missed": added.n_missed},
        "flowers": {"known": added.n_flowers_known, "new": added.n_flowers_new},
        "also_fits": list(added.also_fits),
    }


def tell_added(added: Added, incoming: Incoming, seconds: float) -> None:
    if added.session is None:
        return
    rows = [
        ("session", added.session.session),
        ("plant", added.session.plant),
        ("alignment", _alignment(added, incoming)),
        ("clusters", f"{added.n_known} known again, {added.n_new} new, {added.n_missed} looked at and not seen"),
        ("flowers", f"{added.n_flowers_known} known again, {added.n_flowers_new} new"),
        ("time", f"{seconds:.1f} s"),
    ]
    print_columns("cluster-slam map add", (), rows)


def overlap(added: Added) -> list[str]:
    """A warning where the session fits another plant of the map, too."""
    if not added.also_fits:
        return []
    plant = "" if added.session is None else added.session.plant
    text = f"fits {', '.join(added.also_fits)} as well: it and {plant} may be one plant, or overlap"
    return [f"{text}; flowers that both have are remembered twice"]


def _alignment(added: Added, incoming: Incoming) -> str:
    """How sure the pose is, and how sure the plant's middle stands in the map."""
    if not added.decision.matches or added.decision.accepted is None or added.session is None:
        return "the first session of a plant makes its frame"
    import numpy as np

    from cluster_slam.geometry import skew

    middle = added.session.scale * incoming.constellation.flowers.mean(axis=0)
    lever = np.hstack([-skew(middle), np.eye(3)])
    turn = np.degrees(np.sqrt(np.diag(added.session.cov)[:3].max()))
    shift = 1e3 * np.sqrt(np.diag(lever @ added.session.cov @ lever.T).max())
    return f"sure to {added.session.probability:.4f}; one sigma {turn:.2f} deg, {shift:.1f} mm at the plant's middle"
