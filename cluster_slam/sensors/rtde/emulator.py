"""A controller that a real RTDE client can talk to: it replays a motion and fails on demand.

It runs in a process of its own: ur_rtde's constructor holds the interpreter's lock while it waits for answers, so that
an emulator in a thread of the same process would never give them.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
import time
from collections import Counter
from dataclasses import dataclass

from cluster_slam.errors import InputError
from cluster_slam.sensors.rtde import fields
from cluster_slam.sensors.rtde.faults import Fault
from cluster_slam.sensors.rtde.motion import Motion
from cluster_slam.sensors.rtde.wire import PROTOCOL_VERSION, Package, PackageReader, Recipe, Value, pack

RTDE_PORT = 30004  # fixed in the clients
LATE_PACKAGES = 25  # so many are sent at once after a pause of the machine; older ones are skipped
_LINGER_RESET = struct.pack("ii", 1, 0)  # closing sends RST


@dataclass(frozen=True, slots=True)
class Series:
    """What controllers of one make say of themselves."""

    version: tuple[int, int, int, int]  # major, minor, bugfix, build
    frequency_hz: float  # at most


SERIES = {"e": Series((5, 13, 0, 0), 500.0), "cb3": Series((3, 15, 8, 0), 125.0)}


class Controller:
    """Clock, motion and state of the emulated arm. Times are those of ``time.monotonic``."""

    def __init__(self, motion: Motion, *, uptime_s: float = 0.0) -> None:
        self.motion = motion
        self.unknown: set[str] = set()
        self._begin = self._clock_since = time.monotonic()
        self._clock_at = uptime_s
        self._rate = 1.0
        self._stopped_until = 0.0
        self._stopped_s = 0.0  # how long protective stops have held the motion so far

    def stamp(self, now: float) -> float:
        """The controller's own time, s since it started."""
        return self._clock_at + (now - self._clock_since) * self._rate

    def set_clock(self, now: float, stamp: float, skew_ppm: float | None = None) -> None:
        """From now on the clock goes on from ``stamp``."""
        self._clock_at, self._clock_since = stamp, now
        self._rate = self._rate if skew_ppm is None else 1.0 + 1e-6 * skew_ppm

    def stop(self, now: float, seconds: float) -> None:
        """A protective stop: the motion stands for so long and then goes on."""
        until = max(self._stopped_until, now + seconds)
        self._stopped_s += until - max(self._stopped_until, now)
        self._stopped_until = until

    def type_of(self, name: str) -> str:
        return "NOT_FOUND" if name in self.unknown else fields.type_of(name) or "NOT_FOUND"

    def values(self, names: tuple[str, ...], now: float) -> list[Value]:
        """Values of fields at a time, in their order."""
        is_stopped = now < self._stopped_until
        standing = self._stopped_s - max(self._stopped_until - now, 0.0)
        return [self._value(name, now, now - self._begin - standing, is_stopped) for name in names]

    def _value(self, name: str, now: float, played: float, is_stopped: bool) -> Value:
        if name == "timestamp":
            return self.stamp(now)
        if is_stopped and name in ("safety_mode", "safety_status"):
            return fields.SAFETY_PROTECTIVE_STOP
        if is_stopped and name == "safety_status_bits":
            return fields.BIT_PROTECTIVE_STOP
        recorded = self.motion.value(name, played)
        return fields.default_of(name) if recorded is None else recorded


class Emulator:
    """The server: one thread that listens, one for each client."""

    def __init__(
        self, controller: Controller, *, address: str = "127.0.0.1", port: int = RTDE_PORT, series: str = "e"
    ) -> None:
        self.controller = controller
        self.series = SERIES[series]
        self.counts: Counter[str] = Counter()  # connections, packages sent, packages received by letter, faults
        self._place = (address, port)
        self._until: dict[str, float] = {}  # end of each fault that lasts
        self._clients: dict[socket.socket, threading.Thread] = {}
        self._is_open = True
        self._listener: socket.socket | None = None
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._accept, daemon=True)

    def start(self) -> None:
        """Listen.

        Raises
        ------
        InputError
            The address is not this machine's, or the port is taken.
        """
        self._listen()
        self._thread.start()

    def close(self) -> None:
        """End all connections."""
        self._is_open = False
        self._close_all(is_reset=False)
        if self._thread.is_alive():
            self._thread.join(1.0)

    def do(self, fault: Fault) -> None:
        """Let a fault happen now."""
        now = time.monotonic()
        self.counts[f"fault {fault.kind}"] += 1
        if fault.kind == "unknown":
            self.controller.unknown.add(fault.name)
        elif fault.kind == "skew":
            self.controller.set_clock(now, self.controller.stamp(now), fault.value)
        elif fault.kind == "step":
            self.controller.set_clock(now, self.controller.stamp(now) + fault.value)
        elif fault.kind == "protective-stop":
            self.controller.stop(now, fault.value)
        elif fault.kind in ("stall", "silent", "half"):
            self._until[fault.kind] = now + fault.value
        elif fault.kind == "cut":
            self._until["cut"] = now + 0.1
        else:
            if fault.kind == "restart":
                self.controller.set_clock(now + fault.value, 0.0)
            self._until["drop"] = now + fault.value if fault.kind != "reset" else 0.0
            self._close_all(is_reset=fault.kind == "reset", is_shut=fault.kind != "reset")

    def _is(self, kind: str) -> bool:
        return time.monotonic() < self._until.get(kind, 0.0)

    def _listen(self) -> None:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.settimeout(0.05)
        try:
            listener.bind(self._place)
        except OSError as error:
            listener.close()
            raise InputError(f"{self._place[0]}:{self._place[1]}: cannot listen there ({error.strerror})") from None
        listener.listen()
        self._listener = listener

    def _accept(self) -> None:
        while self._is_open:
            if self._listener is None:
                time.sleep(0.01)
                if not self._is("drop"):
                    with contextlib.suppress(InputError):  # somebody else may hold the port for a moment
                        self._listen()
                continue
            try:
                client, _ = self._listener.accept()
            except OSError:  # nobody for a while, or shut
                continue
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            thread = threading.Thread(target=self._serve, args=(client,), daemon=True)
            with self._lock:
                self._clients[client] = thread
            self.counts["connections"] += 1
            thread.start()

    def _close_all(self, *, is_reset: bool, is_shut: bool = True) -> None:
        if is_shut and self._listener is not None:
            listener, self._listener = self._listener, None
            listener.close()
        with self._lock:
            clients = list(self._clients)
        for client in clients:
            _hang_up(client, is_reset=is_reset)

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError, ValueError, InputError):
            Conversation(self, client).run()
        with self._lock:
            self._clients.pop(client, None)
        _hang_up(client)


class Conversation:
    """What goes on with one client: answers to its packages, and data in between."""

    def __init__(self, emulator: Emulator, client: socket.socket) -> None:
        self._emulator, self._client = emulator, client
        self._reader = PackageReader()
        self._recipe: Recipe | None = None
        self._period = 1.0 / emulator.series.frequency_hz
        self._next = float("inf")  # time of the next data package

    def run(self) -> None:
        """Until either side hangs up."""
        while True:
            if self._emulator._is("silent"):
                time.sleep(0.01)
                continue
            wait = min(max(self._next - time.monotonic(), 0.0), 0.1)
            if select.select([self._client], [], [], wait)[0]:
                data = self._client.recv(4096)
                if not data:
                    return
                for kind, payload in self._reader.feed(data):
                    self._emulator.counts[f"received {chr(kind)}"] += 1
                    self._answer(kind, payload)
            if not self._stream():
                return

    def _answer(self, kind: int, payload: bytes) -> None:
        answer = b""
        if kind == Package.REQUEST_PROTOCOL_VERSION:
            answer = bytes([payload == struct.pack(">H", PROTOCOL_VERSION)])
        elif kind == Package.GET_CONTROLLER_VERSION:
            answer = struct.pack(">4I", *self._emulator.series.version)
        elif kind == Package.SETUP_OUTPUTS:
            answer = self._set_up(payload)
        elif kind in (Package.START, Package.PAUSE):
            is_ready = self._recipe is not None
            self._next = time.monotonic() if kind == Package.START and is_ready else float("inf")
            answer = bytes([is_ready])
        elif kind == Package.SETUP_INPUTS:  # this arm is not commanded: recipe 0 is none
            answer = b"\0"
        else:
            return
        self._client.sendall(pack(kind, answer))

    def _set_up(self, payload: bytes) -> bytes:
        """The types of the fields that a client asks for; from then on they are what data packages hold."""
        frequency = struct.unpack_from(">d", payload)[0]
        names = [name for name in payload[8:].decode("ascii", "replace").split(",") if name]
        types = [self._emulator.controller.type_of(name) for name in names]
        self._period = 1.0 / min(max(frequency, 1.0), self._emulator.series.frequency_hz)
        if "NOT_FOUND" not in types:
            self._recipe = Recipe(1, names, types)
        return bytes([0 if self._recipe is None else 1]) + ",".join(types).encode()

    def _stream(self) -> bool:
        """Send the data packages that are due; False when the connection is to be closed."""
        now = time.monotonic()
        if self._recipe is None or now < self._next:
            return True
        if self._emulator._is("stall"):
            self._next = now + self._period
            return True
        self._next = max(self._next, now - LATE_PACKAGES * self._period)
        while self._next <= now:
            package = self._recipe.data(self._emulator.controller.values(self._recipe.names, self._next))
            middle = len(package) // 2
            if self._emulator._is("cut"):
                self._client.sendall(package[:middle])
                return False
            if self._emulator._is("half"):
                self._client.sendall(package[:middle])
                time.sleep(0.4 * self._period)
                package = package[middle:]
            self._client.sendall(package)
            self._emulator.counts["packages sent"] += 1
            self._next += self._period
        return True


def _hang_up(client: socket.socket, *, is_reset: bool = False) -> None:
    with contextlib.suppress(OSError):
        if is_reset:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_RESET)
            client.close()
        else:
            client.shutdown(socket.SHUT_RDWR)
            client.close()
