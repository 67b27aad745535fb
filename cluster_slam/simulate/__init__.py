"""A bramble plant, an arm that sweeps a camera past it, and what the camera detects: sessions with ground truth."""

from cluster_slam.simulate.config import PRESETS, SimulateConfig
from cluster_slam.simulate.session import Simulated, simulate, simulate_session

__all__ = ["PRESETS", "SimulateConfig", "Simulated", "simulate", "simulate_session"]
