"""``python -m cluster_slam.simulate OUT --preset moderate --seed 3``."""

from __future__ import annotations

import argparse
from pathlib import Path

from cluster_slam.simulate import PRESETS, simulate

parser = argparse.ArgumentParser(description="Write a simulated session with its truth.")
parser.add_argument("out", type=Path)
parser.add_argument("--preset", choices=sorted(PRESETS), default="moderate")
parser.add_argument("--seed", type=int, default=0)
arguments = parser.parse_args()
simulate(PRESETS[arguments.preset], arguments.out, seed=arguments.seed)
