"""The animated replay of a live run, put into its report: who was tracked, who was lost, where each was looked for."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray, Result
from cluster_slam.report.pack import pack
from cluster_slam.report.scene import up_axis

_MOST_ROWS = 60_000  # of a longer run every second (third ...) instant is shown


@dataclass(frozen=True, slots=True, eq=False)
class Instants:
    """All clusters at chosen frames, row by row, frames ascending."""

    frame: IntArray  # (n,)
    cluster: IntArray  # (n,) id
    position: Array  # (n, 3) world, m
    cov: Array  # (n, 3, 3) m^2
    state: IntArray  # (n,) 1 tracked, 2 lost
    sways: IntArray  # (n,) 0 or 1
    seen: IntArray  # (n,) 0 or 1: in this very frame


def with_replay(page: str, result: Result, instants: Instants) -> str:
    """The report ``page`` with a section that plays what the tracker said, instant by instant."""
    if not len(instants.frame):
        return page
    data = json.dumps(replay_json(result, instants), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    folder = resources.files("cluster_slam.report") / "assets"
    section = (folder / "replay.html").read_text("utf-8").replace("{{data}}", data)
    script = f"<script>\n{(folder / 'replay.js').read_text('utf-8')}</script>\n"
    head, end, tail = page.rpartition("</main>")
    tail, close, rest = tail.rpartition("</body>")
    return head + section + end + tail + script + close + rest


def replay_json(result: Result, instants: Instants) -> dict[str, object]:
    """Positions and ellipses as the camera looks at the plant on average: right, up, in metres about the middle."""
    kept = _kept(instants)
    frames, first = np.unique(instants.frame[kept], return_index=True)
    ids, cluster = np.unique(instants.cluster[kept], return_inverse=True)
    axes = _axes(result.T_world_camera)
    middle = np.median(instants.position[kept], axis=0)
    flat = (instants.position[kept] - middle) @ axes.T
    cov = axes @ instants.cov[kept] @ axes.T
    camera = (result.T_world_camera[frames, :3, 3] - middle) @ axes.T
    what = instants.state + 4 * instants.sways + 8 * instants.seen
    return {
        "t": pack(result.session.stamps[frames] - result.session.stamps[0], "f4"),
        "first": pack(np.append(first, len(flat)), "u4"),
        "ids": ids.tolist(),
        "cluster": pack(cluster, "u2"),
        "p": pack(flat, "f4"),
        "cov": pack(cov[:, [0, 0, 1], [0, 1, 1]], "f4"),
        "what": pack(what[kept], "u1"),
        "camera": pack(camera, "f4"),
    }


def _kept(instants: Instants) -> IntArray:
    """Rows that go into the page."""
    every = -(-len(instants.frame) // _MOST_ROWS)
    number = np.unique(instants.frame, return_inverse=True)[1]
    return np.flatnonzero(number % every == 0)


def _axes(T_world_camera: Array) -> Array:
    """Right and up (2, 3) as the camera sees the plant on average."""
    up = np.array(up_axis(T_world_camera))
    forward = T_world_camera[:, :3, 2].mean(0)
    forward = forward - (forward @ up) * up
    size = float(np.linalg.norm(forward))
    if size < 1e-6:  # it looks straight up or down
        forward = np.roll(up, 1)
        size = 1.0
    return np.stack([np.cross(forward / size, up), up])
