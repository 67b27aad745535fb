"""``cluster-slam record``: a robot's arm and a camera become a session."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cluster_slam.cli.options import JsonOption, QuietOption
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.summary import print_json, print_table, print_warnings
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.live.finish import Finished
    from cluster_slam.live.robot_source import RobotSource
    from cluster_slam.live.setup import Mount
    from cluster_slam.live.view import Notice
    from cluster_slam.sensors.rtde.link import RobotSample

_POOR_SHARE = 0.1  # of the frames without a pose: more, and the recording is called poor


def command(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="SESSION", help="Session folder; absent or empty.")],
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="HOST", help="Name or address of the arm.", show_default=False)
    ] = None,
    camera: Annotated[
        str, typer.Option("--camera", metavar="CAMERA", help="none, realsense, or a folder that a program fills.")
    ] = "none",
    duration: Annotated[
        float | None,
        typer.Option("--duration", metavar="S", min=0, help="End after so long; else Ctrl-C.", show_default=False),
    ] = None,
    rate: Annotated[float, typer.Option("--rate", min=1, max=500, help="Samples of the arm a second.")] = 125.0,
    hand_eye: Annotated[
        str | None,
        typer.Option(
            "--hand-eye",
            metavar="'TX TY TZ QX QY QZ QW'",
            help="Camera on the arm's active TCP, as measured.",
            show_default=False,
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="The same from calibration.toml.", show_default=False),
    ] = None,
    plant: Annotated[str | None, typer.Option("--plant", help="Name of the plant.", show_default=False)] = None,
    id_: Annotated[str | None, typer.Option("--id", help="Name of the session.", show_default=False)] = None,
    finish: Annotated[bool, typer.Option("--finish", help="Make the session of a recording that was killed.")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> int:
    """Record a Universal Robots arm, and a camera on it, as a session.

    The arm is only listened to, never commanded. All that comes is on the disk within a second, in SESSION.recording,
    which becomes SESSION at the end; after a crash, --finish does that. A robot that is lost and comes back is waited
    for.

    Example: cluster-slam record --robot 192.168.1.10 --camera realsense -o sessions/monday --duration 60
    """
    from cluster_slam.live.finish import finish as make_session

    told: list[Notice] = []
    if not finish:
        if robot is None:
            raise ConfigError("no --robot HOST, expected the name or address of an arm (or --finish)")
        mount = _mount(hand_eye, calibration)
        with StageProgress(is_shown=not (quiet or as_json)) as progress:
            told = _record(out, robot, camera, duration, rate, mount, plant, id_, progress)
    done = make_session(out)
    warnings = [f"{one.kind.value}: {one.text}" for one in told]
    reasons = _poor(done, has_camera=not finish and camera != "none")
    if as_json:
        print_json({"out": str(out), **_facts(done), "notices": warnings, "status": "poor" if reasons else "ok"})
    elif not quiet:
        print_warnings(warnings)
        print_table("cluster-slam record", [(k.replace("_", " "), _shown(v)) for k, v in _facts(done).items()])
    if reasons:
        print_warnings([f"the recording is poor: {'; '.join(reasons)}"])
    return 1 if reasons else 0


def _mount(hand_eye: str | None, calibration: Path | None) -> Mount:
    from cluster_slam.live.setup import UNKNOWN_MOUNT, mount_of_numbers, read_mount

    if hand_eye is not None and calibration is not None:
        raise ConfigError("--hand-eye and --calibration, expected one of them")
    if calibration is not None:
        return read_mount(calibration)
    if hand_eye is None:
        return UNKNOWN_MOUNT
    try:
        return mount_of_numbers([float(x) for x in hand_eye.replace(",", " ").split()])
    except ValueError:
        raise ConfigError(f"--hand-eye {hand_eye!r}, expected seven numbers") from None


class Stop:
    """Ctrl-C and SIGTERM end the recording in order; a second one is answered as usual."""

    def __init__(self) -> None:
        self.is_asked = False

    def __enter__(self) -> Stop:
        self._before = {one: signal.signal(one, self._ask) for one in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for one, handler in self._before.items():
            signal.signal(one, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self.is_asked:
            raise KeyboardInterrupt
        self.is_asked = True


def _record(
    out: Path,
    host: str,
    camera_name: str,
    duration: float | None,
    rate: float,
    mount: Mount,
    plant: str | None,
    id_: str | None,
    progress: StageProgress,
) -> list[Notice]:
    """Listen until it is over; what happened on the way."""
    from cluster_slam.io.importers.session_files import check_free, session_toml
    from cluster_slam.live.journal import Journal
    from cluster_slam.live.robot_source import RobotSource
    from cluster_slam.live.setup import head_of, live_header, open_camera
    from cluster_slam.sensors.rtde.link import RobotLink

    check_free(out)
    camera = open_camera(camera_name)
    header = live_header(mount, id=id_ or out.name, plant=plant)
    head = session_toml(head_of(header, camera, source=f"recorded from {host}, camera {camera_name}"))
    waiting: list[RobotSample] = []
    told: list[Notice] = []
    with Stop() as stop:
        source = RobotSource(RobotLink(host, rate_hz=rate), camera, header, on_samples=waiting.extend)
        progress(f"waiting for {host}", 0.0)
        with source, Journal(out, head) as journal:
            source.on_view = journal.view
            begin = time.monotonic()
            while not (stop.is_asked or camera.is_over or (duration and time.monotonic() - begin > duration)):
                _step(source, journal, waiting, told)
                journal.intrinsics(camera.intrinsics)
                progress(_words(journal, told), 0.0 if not duration else (time.monotonic() - begin) / duration)
            _last_views(source, journal, waiting, told)
    return told


def _step(source: RobotSource, journal: Any, waiting: list[RobotSample], told: list[Notice]) -> None:
    if source.step() is None:
        time.sleep(0.002)
    journal.samples(waiting)
    waiting.clear()
    notices = source.notices()
    journal.notices(notices)
    told += notices
    journal.keep()


def _last_views(source: RobotSource, journal: Any, waiting: list[RobotSample], told: list[Notice]) -> None:
    """The robot's samples beyond the last view are on their way."""
    end = time.monotonic() + 0.3
    while time.monotonic() < end:
        _step(source, journal, waiting, told)


def _words(journal: Any, told: list[Notice]) -> str:
    last = f", {told[-1].text}" if told else ""
    return f"{journal.n_samples} samples, {journal.n_views} views{last}"


def _poor(done: Finished, *, has_camera: bool) -> list[str]:
    if has_camera and not done.n_views:
        return ["the camera gave nothing"]
    all_frames = done.n_frames + done.n_without_pose
    if done.n_without_pose > _POOR_SHARE * all_frames:
        return [f"{done.n_without_pose} of {all_frames} frames have no pose, the robot was lost then"]
    return []


def _facts(done: Finished) -> dict[str, Any]:
    clock = done.clocks[-1]
    return {
        "robot_samples": done.n_samples,
        "views": done.n_views,
        "frames": done.n_frames,
        "frames_without_pose": done.n_without_pose,
        "points": done.n_points,
        "robot_lost_s": [round(length, 3) for _, length in done.losses],
        "clock_drift_ppm": round(1e6 * clock.drift, 2),
        "clock_jitter_ms": round(1e3 * clock.jitter_s, 3),
        "clock_stretches": len(done.clocks),
    }


def _shown(value: Any) -> str:
    return (", ".join(map(str, value)) or "never") if isinstance(value, list) else str(value)
