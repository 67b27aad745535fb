"""Tracking of frames as they come, to be read like the method section of a paper."""

from __future__ import annotations

import tempfile
from array import array
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from cluster_slam.config import OnlineConfig
from cluster_slam.errors import ClusterSlamError, InputError
from cluster_slam.geometry import Array
from cluster_slam.live.replay import Replay
from cluster_slam.live.view import FrameSource, Notice
from cluster_slam.online.intake import usable_points
from cluster_slam.online.journal import CONFIRMED, LOST, SEEN, SWAYING, Journal, Told
from cluster_slam.online.journal import resume as resume_journal
from cluster_slam.online.records import Update
from cluster_slam.online.result import make_result
from cluster_slam.online.tracker import OnlineTracker
from cluster_slam.records import Calibration, Frame, Observations, Result, Session
from cluster_slam.report.replay import Instants

Progress = Callable[[str, float], None]
_UNKNOWN_RAD, _UNKNOWN_M = 0.5, 0.5  # one sigma: beyond these it cannot be corrected step by step
_NO_POINTS = "rows that are no points were left out"
_MOST_WARNINGS = 200  # of a run of days, with a stamp in each


class StoppedError(ClusterSlamError):
    """Tracking was stopped before the end, on request; ``journal`` is where it can go on."""

    def __init__(self, message: str, journal: Path) -> None:
        super().__init__(f"{message}; what was tracked is in {journal}, --resume goes on from there")
        self.journal = journal


def track(
    session: Session,
    *,
    calibration: Calibration | None = None,
    config: OnlineConfig | None = None,
    seed: int = 0,
    realtime: bool = False,
    out: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    on_update: Callable[[Update], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Result:
    """Follow a session frame by frame, as if it were live: each row is what was known when its frame was processed.

    Parameters
    ----------
    session : as ``open_session`` reads it.
    calibration : hand-eye transform to rely on; None: estimated in the first seconds, then frozen.
    config : the options, defaults where None.
    seed : of what is random (K-means only).
    realtime : at the pace of the stamps; otherwise as fast as it goes.
    out : the journal of the run lies beside this folder, and what was tracked so far is in it at any time; None:
        in a temporary place.
    resume : go on from such a journal.
    progress : called with the stage in words and a fraction 0..1.
    on_update : called with each update.
    should_stop : asked after each frame; a yes ends the run, which can then be resumed.

    Raises
    ------
    StoppedError
        Somebody wanted it to stop; the journal holds what was tracked.
    InputError
        There is nothing to resume, or of another session; or nobody knows how the camera is mounted.
    OutputError
        The journal cannot be written.
    """
    say = progress or (lambda _stage, _fraction: None)
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary) / "result" if out is None else out
        tracker, n_done = _begin(session, place, calibration, config, seed, resume)
        begun = perf_counter()
        with Journal(place, session.id, n_frames=n_done) as journal:
            times = np.zeros(max(session.n_frames - n_done, 0))
            for i, frame in enumerate(_frames(session, n_done, realtime)):
                before = process_time()
                update = tracker.step(frame)
                journal.write(update, tracker)
                times[i] = process_time() - before
                if on_update is not None:
                    on_update(update)
                if should_stop is not None and should_stop():
                    journal.mark(tracker)
                    raise StoppedError(f"stopped after {journal.n_frames} of {session.n_frames} frames", journal.folder)
                if i % 30 == 0:
                    say("tracking", (n_done + i) / session.n_frames)
            result = make_result(session, tracker, journal.read(), _timings(times, perf_counter() - begun))
        return replace(result, seed=seed)


def track_source(
    source: FrameSource,
    out: Path,
    *,
    calibration: Calibration | None = None,
    config: OnlineConfig | None = None,
    seed: int = 0,
    resume: bool = False,
    on_update: Callable[[Update], None] | None = None,
    on_notice: Callable[[Notice], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Result:
    """Follow a live source until it ends or somebody wants to stop; frames that were refused are in no table.

    Parameters as of ``track``; ``on_notice`` is called with what happens to the source. The journal lies beside
    ``out`` until the caller has written the result, and holds what came in as well: memory does not grow.

    Raises
    ------
    InputError
        There is nothing to resume.
    OutputError
        The journal cannot be written; what was tracked so far is in it.
    """
    header = source.header
    tracker, n_done = _begin(header, out, calibration, config, seed, resume)
    times, told = array("d"), dict.fromkeys(header.warnings)
    begun = perf_counter()
    with Journal(out, header.id, n_frames=n_done) as journal:
        for given in source.frames():
            frame = _points_only(given)
            before = process_time()
            update = tracker.step(frame)
            if update.is_accepted:
                journal.keep(frame)
                journal.write(update, tracker, tracker.last_stamp)
            times.append(process_time() - before)
            told |= dict.fromkeys(update.warnings if len(frame) == len(given) else (*update.warnings, _NO_POINTS))
            _pass_on(source.notices(), told, on_notice)
            if on_update is not None:
                on_update(update)
            if should_stop is not None and should_stop():
                break
        _pass_on(source.notices(), told, on_notice)
        journal.mark(tracker)
        said = journal.read()
        session = _session_of(header, said)
        result = make_result(session, tracker, said, _timings(np.array(times), perf_counter() - begun))
    return replace(result, seed=seed, warnings=tuple(dict.fromkeys([*result.warnings, *told]))[:_MOST_WARNINGS])


def _points_only(frame: Frame) -> Frame:
    """The frame without rows that are no points: a session has none."""
    usable = usable_points(frame.points, frame.covs)
    if usable.all():
        return frame
    scores = None if frame.scores is None else frame.scores[usable]
    return replace(frame, points=frame.points[usable], covs=frame.covs[usable], scores=scores)


def _pass_on(notices: list[Notice], told: dict[str, None], listen: Callable[[Notice], None] | None) -> None:
    for notice in notices:
        told[f"{notice.kind.value}: {notice.text}"] = None
        if listen is not None:
            listen(notice)


def _session_of(header: Session, said: Told) -> Session:
    """The session that a live source has been."""
    observations = Observations(
        frame=said.rows["frame"].astype(np.int64),
        points=said.points["point"].copy(),
        covs=said.points["cov"].copy(),
        scores=said.points["score"].copy(),
    )
    stamps, poses = said.frames["stamp"].copy(), said.given["pose"].copy()
    return replace(header, stamps=stamps, poses=poses, observations=observations)


def instants_of(said: Told) -> Instants:
    """All clusters ten times a second, for the report's replay."""
    rows = said.tracks
    what = rows["what"].astype(np.int64)
    return Instants(
        frame=rows["frame"].astype(np.int64),
        cluster=rows["cluster"].astype(np.int64),
        position=rows["position"].astype(np.float64),
        cov=rows["cov"].astype(np.float64),
        state=what & (CONFIRMED | LOST),
        sways=(what & SWAYING) // SWAYING,
        seen=(what & SEEN) // SEEN,
    )


def _begin(
    session: Session,
    out: Path,
    calibration: Calibration | None,
    config: OnlineConfig | None,
    seed: int,
    resume: bool,
) -> tuple[OnlineTracker, int]:
    """A new tracker, or the one of the last mark, and how many frames it has taken."""
    if resume:
        return resume_journal(out, session.id)
    given = calibration if session.T_flange_camera is not None else None
    _check_mount(session, given)
    tracker = OnlineTracker(
        session.noise,
        session.T_flange_camera,
        calibration=given,
        pose_error=session.pose_error,
        config=config,
        seed=seed,
    )
    return tracker, 0


def can_be_tracked(session: Session) -> bool:
    """Whether the camera's mount is known well enough: a live tracker cannot try all orientations."""
    n = session.noise
    is_known = n.hand_eye_rotation <= _UNKNOWN_RAD and n.hand_eye_translation <= _UNKNOWN_M
    return session.T_flange_camera is None or is_known


def _check_mount(session: Session, given: Calibration | None) -> None:
    """Refuse a camera of which nobody knows how it is mounted."""
    n = session.noise
    if given is None and not can_be_tracked(session):
        known = f"known to {n.hand_eye_translation:g} m and {n.hand_eye_rotation:g} rad"
        expected = "expected --calibration FILE (smooth and calibrate find the transform)"
        raise InputError(f"{session.id}: the hand-eye transform is only {known}, {expected}")


def _frames(session: Session, n_done: int, realtime: bool) -> Iterator[Frame]:
    frames = Replay(session, is_realtime=realtime).frames()
    for i, frame in enumerate(frames):
        if i >= n_done:
            yield frame


def _timings(times: Array, total: float) -> dict[str, float]:
    if not len(times):
        return {"tracking": total}
    p50, p99 = np.percentile(times, [50, 99])
    return {"tracking": total, "frame_p50": p50, "frame_p99": p99, "frame_longest": float(times.max())}
