"""``cluster-slam rtde-emulator``: an arm's controller that is not there."""

from __future__ import annotations

import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.summary import print_json, print_table
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.sensors.rtde.emulator import Emulator
    from cluster_slam.sensors.rtde.faults import Fault


def command(
    motion: Annotated[
        Path,
        typer.Argument(metavar="MOTION", help="TUM trajectory, RTDE log (CSV) or session to play.", show_default=False),
    ],
    bind: Annotated[str, typer.Option("--bind", metavar="ADDRESS", help="Where to listen.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=1, max=65535, help="Clients of ur_rtde know only 30004.")] = 30004,
    series: Annotated[str, typer.Option("--series", help="e (500 Hz) or cb3 (125 Hz).")] = "e",
    uptime: Annotated[float, typer.Option("--uptime", metavar="S", help="Where the controller's clock begins.")] = 0.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="KIND[:VALUE]@S",
            help="A fault S seconds from the start; may be repeated. Kinds: drop, reset, stall, silent, half, cut, "
            "unknown, protective-stop, restart, skew, step.",
            show_default=False,
        ),
    ] = None,
    control: Annotated[
        bool, typer.Option("--control", help="Read faults from stdin, one a line, as they are to happen; ends with it.")
    ] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Play the motion back and forth for ever.")] = False,
    duration: Annotated[
        float | None, typer.Option("--duration", metavar="S", min=0, help="End after so long.", show_default=False)
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Emulate the controller of a Universal Robots arm, for real RTDE clients, with faults on demand.

    It speaks RTDE version 2, replays the poses of MOTION and takes no commands. It runs until Ctrl-C.

    Example: cluster-slam rtde-emulator data/sample --loop --fault stall:2@5 --fault protective-stop:3@10
    """
    from cluster_slam.live.motion_file import read_motion
    from cluster_slam.sensors.rtde.emulator import SERIES, Controller, Emulator
    from cluster_slam.sensors.rtde.faults import parse_fault

    if series not in SERIES:
        raise ConfigError(f"unknown series {series!r}, expected {' or '.join(SERIES)}")
    faults = sorted((parse_fault(text) for text in fault or []), key=lambda one: one.at_s)
    played = read_motion(motion, goes_back=loop)
    controller, began = Controller(played, uptime_s=uptime), time.time()
    emulator = Emulator(controller, address=bind, port=port, series=series)
    emulator.start()
    if not (quiet or as_json):
        sys.stdout.write(f"listening on {bind}:{port}\n")
        sys.stdout.flush()
    _run(emulator, faults, duration, _read_control(emulator) if control else None)
    emulator.close()
    counts = dict(sorted(emulator.counts.items()))
    if as_json:
        print_json({"address": f"{bind}:{port}", "began": began, "counts": counts})
    elif not quiet:
        print_table("cluster-slam rtde-emulator", [(name, str(n)) for name, n in counts.items()])
    return 0


def _run(emulator: Emulator, faults: list[Fault], duration: float | None, reader: threading.Thread | None) -> None:
    """Let faults happen when they are due, until time is up, stdin ends, or somebody stops us."""
    former = signal.signal(signal.SIGTERM, signal.default_int_handler)
    begin = time.monotonic()
    try:
        while duration is None or time.monotonic() - begin < duration:
            while faults and time.monotonic() - begin >= faults[0].at_s:
                emulator.do(faults.pop(0))
            if reader is not None and not reader.is_alive():
                return
            time.sleep(0.02)
    except KeyboardInterrupt:
        return
    finally:
        signal.signal(signal.SIGTERM, former)


def _read_control(emulator: Emulator) -> threading.Thread:
    """A thread that does what stdin says."""
    from cluster_slam.sensors.rtde.faults import parse_fault

    def read() -> None:
        for line in sys.stdin:
            if not line.strip():
                continue
            try:
                emulator.do(parse_fault(line))
            except ConfigError as error:
                sys.stderr.write(f"{error}\n")

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    return thread
