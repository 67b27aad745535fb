"""The real client of ur_rtde against the emulator: what it reads, and what it survives."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rtde_help import SPEED, UPTIME, EmulatedRobot, line_motion

from cluster_slam.errors import InputError
from cluster_slam.sensors.rtde.link import LinkEvent, LinkState, RobotLink, RobotSample

CLIENT = """
import sys, time
from rtde_receive import RTDEReceiveInterface
host, rate, names = sys.argv[1], float(sys.argv[2]), sys.argv[3].split(",") if sys.argv[3] else []
client = RTDEReceiveInterface(host, rate, names)
stamps, end, torn = set(), time.time() + 1.5, 0
while time.time() < end:
    before = client.getTimestamp()
    pose = client.getActualTCPPose()
    if client.getTimestamp() == before:
        torn += abs(pose[0] - 0.1 * (before - 1000.0)) > 1e-9
        stamps.add(before)
    time.sleep(0.0004)
order = sorted(stamps)
step = min(b - a for a, b in zip(order, order[1:]))
print(len(stamps), order[-1] - order[0], step, torn, client.getRobotMode(), client.isProtectiveStopped())
"""


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[EmulatedRobot]:
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        yield robot


class Watch:
    """All that a link told so far."""

    def __init__(self, link: RobotLink) -> None:
        self._link = link
        self.samples: list[RobotSample] = []
        self.events: list[LinkEvent] = []

    def look(self) -> None:
        samples, events = self._link.take()
        self.samples += samples
        self.events += events

    def until(self, state: LinkState, timeout_s: float = 10.0) -> float:
        """Wait for a state; how long it took, s."""
        begin = time.monotonic()
        while self._link.state is not state:
            assert time.monotonic() - begin < timeout_s, (state, self.events)
            self.look()
            time.sleep(0.01)
        self.look()
        return time.monotonic() - begin

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


@pytest.mark.parametrize(("series", "rate"), [("e", 500), ("cb3", 125), ("e", 125)])
def test_the_real_client_reads_it(tmp_path: Path, series: str, rate: int) -> None:
    """Stamps a second as asked for; between two readings of one stamp the pose is of that stamp: x = speed * time."""
    names = "timestamp,actual_TCP_pose,actual_q,robot_mode,safety_status_bits"
    with EmulatedRobot(line_motion(tmp_path), "--series", series) as robot:
        command = [sys.executable, "-c", CLIENT, robot.host, str(rate), names]
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    n, span, step, torn, mode, is_stopped = done.stdout.split()
    assert int(torn) == 0
    assert (int(mode), is_stopped) == (7, "False")
    assert int(n) <= rate * 1.5 + 2
    assert int(n) > 0.15 * rate * 1.5  # a busy machine misses some; by their stamps the rate is that asked for
    assert 0.8 < float(span) < 2.0
    assert float(step) == pytest.approx(1 / rate, rel=1e-3)
    assert {kind for kind in robot.summary["counts"] if kind.startswith("received")} == {
        f"received {letter}" for letter in "VvOS"
    }  # nothing that would command an arm


def test_the_real_client_with_its_own_recipe(robot: EmulatedRobot) -> None:
    """Without a list of variables it asks for all it knows."""
    command = [sys.executable, "-c", CLIENT, robot.host, "-1", ""]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    n, _, step, torn, *_ = done.stdout.split()
    assert (int(n) > 100, int(torn)) == (True, 0)
    assert float(step) == pytest.approx(0.002, rel=1e-3)


def test_samples_are_the_controllers(robot: EmulatedRobot) -> None:
    with RobotLink(robot.host) as link:
        link.wait(10)
        watch = Watch(link)
        time.sleep(1.0)
        watch.look()
        assert link.state is LinkState.STREAMING
    stamps = np.array([one.stamp for one in watch.samples])
    x = np.array([one.pose[0] for one in watch.samples])
    assert len(stamps) > 20
    assert np.diff(stamps).min() == pytest.approx(0.008, abs=1e-6)
    assert np.abs(x - SPEED * (stamps - UPTIME)).max() < 1e-9
    angle = np.array([one.pose[5] for one in watch.samples])
    assert np.abs(angle - 0.2 * (stamps - UPTIME)).max() < 1e-6
    assert {one.robot_mode for one in watch.samples} == {7}
    assert not any(one.is_stopped for one in watch.samples)
    assert watch.kinds() == ["connected"]


@pytest.mark.parametrize(
    ("fault", "is_new_connection"),
    [("stall:0.6", False), ("drop:0.8", True), ("reset", True), ("cut", True), ("restart:0.8", True)],
)
def test_a_robot_that_is_lost_comes_back(robot: EmulatedRobot, fault: str, is_new_connection: bool) -> None:
    with RobotLink(robot.host) as link:
        link.wait(10)
        watch = Watch(link)
        robot.do(fault)
        watch.until(LinkState.LOST)
        watch.until(LinkState.STREAMING)
    assert ("lost" in watch.kinds()) == is_new_connection
    assert watch.kinds().count("connected") == 1 + is_new_connection
    stamps = np.array([one.stamp for one in watch.samples])
    gap = np.diff(stamps).max()
    x = np.array([one.pose[0] for one in watch.samples])
    if fault.startswith("restart"):
        assert stamps[-1] < UPTIME
    else:
        assert gap > 0.1
        assert np.abs(x - SPEED * (stamps - UPTIME)).max() < 1e-9  # nothing old, nothing torn


def test_half_packages_are_put_together(robot: EmulatedRobot) -> None:
    with RobotLink(robot.host) as link:
        link.wait(10)
        watch = Watch(link)
        robot.do("half:1")
        time.sleep(1.2)
        watch.look()
    stamps = np.array([one.stamp for one in watch.samples])
    x = np.array([one.pose[0] for one in watch.samples])
    assert watch.kinds() == ["connected"]
    assert np.abs(x - SPEED * (stamps - UPTIME)).max() < 1e-9
    assert len(stamps) > 20


def test_a_protective_stop_is_told(robot: EmulatedRobot) -> None:
    with RobotLink(robot.host) as link:
        link.wait(10)
        watch = Watch(link)
        robot.do("protective-stop:0.5")
        time.sleep(1.0)
        watch.look()
    assert watch.kinds() == ["connected", "protective_stop", "released"]
    x = np.array([one.pose[0] for one in watch.samples if one.is_stopped])
    assert np.ptp(x) == 0.0  # the arm stands
    stopped = np.array([one.stamp for one in watch.samples if one.is_stopped])
    assert np.ptp(stopped) == pytest.approx(0.5, abs=0.25)
    last = watch.samples[-1]
    assert SPEED * (last.stamp - UPTIME) - last.pose[0] == pytest.approx(0.5 * SPEED, abs=1e-6)


def test_a_controller_without_a_field(robot: EmulatedRobot) -> None:
    """One that can be done without is; one that cannot is named."""
    robot.do("unknown:actual_q")
    time.sleep(0.1)
    with RobotLink(robot.host) as link:
        link.wait(10)
        assert link.fields == ("timestamp", "actual_TCP_pose", "robot_mode", "safety_status_bits")
        samples, events = link.take()
        assert np.isnan(samples[0].joints).all()
        assert "without actual_q" in events[0].text
    robot.do("unknown:actual_TCP_pose")
    time.sleep(0.1)
    with RobotLink(robot.host) as link, pytest.raises(InputError, match="actual_TCP_pose"):
        link.wait(2.0)


def test_a_server_that_never_answers_does_not_hang_us(robot: EmulatedRobot) -> None:
    """The client's constructor would hang for ever, lock held."""
    robot.do("silent:4")
    time.sleep(0.1)
    with RobotLink(robot.host, connect_s=1.5) as link:
        assert link.state is LinkState.CONNECTING
        watch = Watch(link)
        watch.until(LinkState.STREAMING, 12.0)
    assert watch.events[0].kind == "refused"
    assert "hung" in watch.events[0].text


def test_nobody_there() -> None:
    begin = time.monotonic()
    with RobotLink("127.1.1.1") as link, pytest.raises(InputError, match=r"127\.1\.1\.1: no data in 1 s"):
        link.wait(1.0)
    assert time.monotonic() - begin < 3.0


def test_the_link_leaves_no_process(robot: EmulatedRobot) -> None:
    import psutil

    before = {child.pid for child in psutil.Process().children(recursive=True)}
    with RobotLink(robot.host) as link:
        link.wait(10)
        assert len({child.pid for child in psutil.Process().children(recursive=True)} - before) == 1
    assert {child.pid for child in psutil.Process().children(recursive=True)} <= before
