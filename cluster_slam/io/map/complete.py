"""A result folder completed with what the map says: identities and the alignment."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cluster_slam.errors import InputError, OutputError
from cluster_slam.geometry import tum_from_pose
from cluster_slam.io.folder import check_writable, recover, write_folder
from cluster_slam.io.map.store import MapStore, StoredSession

_HEAD = "{}_id,map_id,probability,new_map_id"


def check_result(folder: Path) -> None:
    """Refuse, before any work, a result that could not be completed.

    Raises
    ------
    OutputError
        The folder cannot be replaced.
    """
    check_writable(folder)
    recover(folder)


def is_complete(folder: Path) -> bool:
    """Whether a result says already who is who in a map."""
    return (folder / "identities.csv").exists() and (folder / "flower_identities.csv").exists()


def complete_result(folder: Path, store: MapStore, session: StoredSession) -> None:
    """Write ``identities.csv``, ``flower_identities.csv`` and the alignment in ``run.json``, all or nothing.

    Raises
    ------
    OutputError
        The folder cannot be written; it is as it was.
    """
    clusters = _identities(store, "observations", "cluster", session.id)
    flowers = _identities(store, "flower_observations", "flower", session.id)
    aligned = {
        "aligned": True,
        "plant": session.plant,
        "T_map_world": tum_from_pose(session.T_map_world).tolist(),
        "T_map_world_cov": session.cov.tolist(),
        "map_scale": session.scale,
        "alignment_probability": session.probability,
    }
    replace_files(folder, {"identities.csv": clusters, "flower_identities.csv": flowers}, aligned)


def replace_files(folder: Path, files: dict[str, str], more: dict[str, Any]) -> None:
    """A result folder with further files and further keys in ``run.json``, replaced as a whole.

    Raises
    ------
    OutputError
        The folder cannot be written; it is as it was.
    """
    try:
        content: dict[str, str | bytes] = {e.name: e.read_bytes() for e in sorted(folder.iterdir()) if e.is_file()}
        run = json.loads((folder / "run.json").read_text("utf-8"))
    except OSError as error:
        raise OutputError(f"{folder}: cannot be read ({error.strerror}), expected a result folder") from None
    except ValueError:
        raise InputError(f"{folder / 'run.json'}: no JSON, expected the record of a run") from None
    content |= files
    run |= more
    run["files"] = sorted(content)
    content["run.json"] = json.dumps(run, indent=2) + "\n"
    write_folder(folder, content)


def _identities(store: MapStore, table: str, what: str, session_id: int) -> str:
    rows = store.read(
        f"SELECT local_id, {what}_id, probability, is_new FROM {table} "
        "WHERE session_id = ? AND local_id IS NOT NULL ORDER BY local_id",
        (session_id,),
    )
    lines = [f"{local},,{p:.6f},{known}" if is_new else f"{local},{known},{p:.6f}," for local, known, p, is_new in rows]
    return "\n".join([_HEAD.format(what), *lines, ""])
