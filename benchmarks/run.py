"""All benchmarks in one run: every ``bench_*.py`` beside this file, as a table and as JSON.

    python benchmarks/run.py [--quick] [--gate] [-o OUT.json] [--against BEFORE.json] [NAME ...]

``--gate``: exit with 1 where a goal is missed. ``--against``: show each figure over that of an earlier run.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from figure import Figure  # noqa: E402

HERE = Path(__file__).parent


def main() -> int:
    """Run what was asked for; all where nothing was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as smooth; default: all")
    parser.add_argument("--quick", action="store_true", help="the small cases only")
    parser.add_argument("--gate", action="store_true", help="exit with 1 where a goal is missed")
    parser.add_argument("-o", "--out", type=Path, default=HERE.parent / "out" / "benchmarks.json")
    parser.add_argument("--against", type=Path, help="an earlier run's JSON")
    asked = parser.parse_args()
    before = (
        {} if asked.against is None else {row["name"]: row["value"] for row in json.loads(asked.against.read_text())}
    )
    figures: list[Figure] = []
    for name in asked.names or sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py")):
        for figure in importlib.import_module(f"bench_{name}").measure(asked.quick):
            figures.append(figure)
            print(_line(figure, before.get(figure.name)), flush=True)
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    asked.out.write_text(json.dumps([asdict(figure) for figure in figures], indent=2) + "\n")
    return int(asked.gate and not all(figure.is_met for figure in figures))


def _line(figure: Figure, before: float | None) -> str:
    goal = "" if figure.goal is None else f"goal {figure.goal:g}: {'met' if figure.is_met else 'MISSED'}"
    change = "" if before is None else f"{figure.value / before:.2f} times the earlier"
    return f"{figure.name:60} {figure.value:9.4g} {figure.unit:6} {goal:20} {change}".rstrip()


if __name__ == "__main__":
    sys.exit(main())
