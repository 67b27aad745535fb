"""What ``cluster-slam track`` does with a robot: open it, follow it, keep what came in; and who is told of updates."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from cluster_slam.cli.track_view import TrackView
from cluster_slam.errors import ConfigError

if TYPE_CHECKING:
    from cluster_slam.cli.progress import StageProgress
    from cluster_slam.cli.stopping import Stopping
    from cluster_slam.config import OnlineConfig
    from cluster_slam.io.observed import Detector
    from cluster_slam.live.setup import Mount
    from cluster_slam.live.view import Notice
    from cluster_slam.online.records import Update
    from cluster_slam.online.stream import Stream
    from cluster_slam.records import Calibration, Result


class Listeners:
    """The stream and the picture in the terminal, called with each update; ``lost`` says in the end what was lost."""

    def __init__(self, stream: str | None, view: bool, *, patient: bool) -> None:
        self._where, self._wants_view, self._patient = stream, view, patient
        self._stack = ExitStack()
        self._stream: Stream | None = None
        self._view: TrackView | None = None
        self.lost: tuple[str, ...] = ()

    def __enter__(self) -> Self:
        from cluster_slam.online.stream import open_stream

        if self._where is not None:
            self._stream = open_stream(self._where, patient=self._patient)
        if self._wants_view:
            self._view = self._stack.enter_context(TrackView())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
        if self._stream is not None:
            self.lost = self._stream.close()

    def __call__(self, update: Update) -> None:
        """Tell all of an update."""
        if self._stream is not None:
            self._stream.put(update)
        if self._view is not None:
            self._view.show(update)


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """The options that a robot has and a session has not."""

    host: str | None
    camera: str | None
    hand_eye: str | None
    duration: float | None
    record: Path | None
    calibration: Path | None
    model: Path | None
    detector: str | None

    def check_unused(self) -> None:
        """Refuse them where there is no robot."""
        mine = {"--camera": self.camera, "--hand-eye": self.hand_eye, "--duration": self.duration}
        for name, value in (mine | {"--record": self.record}).items():
            if value is not None:
                raise ConfigError(f"{name} without --robot HOST")

    def check(self) -> None:
        """Refuse a robot without a camera, or one whose mount nobody knows."""
        if self.camera is None:
            raise ConfigError("--robot without --camera, expected realsense or a folder that a program fills")
        if (self.hand_eye is None) == (self.calibration is None):
            raise ConfigError("--robot follows with --calibration FILE or --hand-eye NUMBERS, expected one of them")

    def mount(self) -> Mount:
        """How the camera sits on the arm."""
        from cluster_slam.live.setup import mount_of_numbers, read_mount

        if self.calibration is not None:
            return read_mount(self.calibration)
        try:
            return mount_of_numbers([float(x) for x in (self.hand_eye or "").replace(",", " ").split()])
        except ValueError:
            raise ConfigError(f"--hand-eye {self.hand_eye!r}, expected seven numbers") from None

    def finder(self) -> Detector | None:
        """The detector for a camera that gives pictures; None for a folder that has positions."""
        from cluster_slam.cli.detect import open_named

        has_positions = self.camera is not None and (Path(self.camera) / "flowers.csv").exists()
        if not has_positions:
            return open_named(self.model, self.detector)
        if self.model is not None or self.detector is not None:
            raise ConfigError(f"{self.camera}: has flowers.csv, expected no detector")
        return None


def follow_robot(
    live: LiveOptions,
    out: Path,
    options: OnlineConfig,
    seed: int,
    resume: bool,
    listeners: Listeners,
    progress: StageProgress,
    stopping: Stopping,
) -> Result:
    """Follow the camera on an arm until it ends, the time is over, or somebody wants to stop."""
    from cluster_slam.io.session_writer import check_session_output, write_session
    from cluster_slam.live.robot import open_robot
    from cluster_slam.pipeline.track import track_source

    if live.record is not None:
        check_session_output(live.record)
    n_frames, said = 0, ""

    def tell(update: Update) -> None:
        nonlocal n_frames
        n_frames += 1
        listeners(update)
        progress(f"frame {n_frames}, {sum(s == 'confirmed' for s in update.tracks.states)} clusters{said}", 0.0)

    def note(notice: Notice) -> None:
        nonlocal said
        said = f", {notice.text}"

    source = open_robot(live.host or "", live.camera or "", live.mount(), detector=live.finder(), id=out.name)
    progress(f"waiting for {live.host}", 0.0)
    with source:
        stopping.then = source.stop
        timer = None if live.duration is None else threading.Timer(live.duration, source.stop)
        if timer is not None:
            timer.daemon = True
            timer.start()
        if stopping():
            source.stop()
        result = track_source(
            source,
            out,
            calibration=_known(live.calibration),
            config=options,
            seed=seed,
            resume=resume,
            on_update=tell,
            on_notice=note,
            should_stop=stopping,
        )
    if live.record is not None:
        write_session(live.record, result.session)
    return result


def _known(calibration: Path | None) -> Calibration | None:
    from cluster_slam.io.read_result import read_calibration

    return None if calibration is None else read_calibration(calibration)
