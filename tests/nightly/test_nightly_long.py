"""Long sessions: time and memory of the whole command, in a process of its own."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
from tables import Tables

pytestmark = pytest.mark.nightly


@dataclass(frozen=True, slots=True)
class Spent:
    """What the command took."""

    n_observations: int
    seconds: float  # of the processor
    peak_gb: float


def spend(folder: Path, preset: str) -> Spent:
    """Simulate and smooth a session by the command line."""
    program = [sys.executable, "-m", "cluster_slam.cli"]
    subprocess.run([*program, "simulate", str(folder / preset), "--preset", preset, "--quiet"], check=True)
    command = [*program, "smooth", str(folder / preset), "-o", str(folder / "result"), "--json"]
    with (folder / "answer.json").open("w") as answer:
        process = subprocess.Popen(command, stdout=answer)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)  # it has been waited for
    assert process.returncode == 0
    counts = json.loads((folder / "answer.json").read_text())["counts"]
    return Spent(counts["observations"], usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e6)


def test_five_and_twenty_thousand_frames(tmp_path: Path, add_row: Tables) -> None:
    short, long = spend(tmp_path, "moderate-long"), spend(tmp_path, "moderate-longest")
    for frames, spent in ((5_000, short), (20_000, long)):
        row = {"seconds": spent.seconds, "peak_gb": spent.peak_gb}
        add_row("long", frames=frames, observations=spent.n_observations, **row)
    power = math.log(long.seconds / short.seconds) / math.log(long.n_observations / short.n_observations)
    add_row("growth", from_frames=5_000, to_frames=20_000, power=power)
    assert short.seconds < 120
    assert short.peak_gb < 2
    assert power <= 1.2
