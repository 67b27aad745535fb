"""The live tracker: one frame in, one update out."""

from __future__ import annotations

from cluster_slam.online.records import Revision, Tracks, Update
from cluster_slam.online.tracker import OnlineTracker

__all__ = ["OnlineTracker", "Revision", "Tracks", "Update"]
