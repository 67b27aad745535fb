"""Which flower cluster is this? Landmark SLAM with clusters of flowers.

The public calls are loaded when they are first used, so that ``import cluster_slam`` stays quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from cluster_slam.evaluation import evaluate
    from cluster_slam.io.session import open_session
    from cluster_slam.online import OnlineTracker
    from cluster_slam.pipeline.calibrate import calibrate
    from cluster_slam.pipeline.localise import localise
    from cluster_slam.pipeline.smooth import smooth
    from cluster_slam.pipeline.track import track
    from cluster_slam.simulate import simulate

_PUBLIC = {
    "OnlineTracker": "cluster_slam.online",
    "calibrate": "cluster_slam.pipeline.calibrate",
    "evaluate": "cluster_slam.evaluation",
    "localise": "cluster_slam.pipeline.localise",
    "open_session": "cluster_slam.io.session",
    "simulate": "cluster_slam.simulate",
    "smooth": "cluster_slam.pipeline.smooth",
    "track": "cluster_slam.pipeline.track",
}
__all__ = [
    "OnlineTracker",
    "__version__",
    "calibrate",
    "evaluate",
    "localise",
    "open_session",
    "simulate",
    "smooth",
    "track",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
