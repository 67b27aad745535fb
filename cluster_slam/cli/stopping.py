"""Ctrl-C and SIGTERM end a long run after the step that it is in, not in the middle of it."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType


class Stopping:
    """A context in which the first signal is a request; the second is what it always was."""

    def __init__(self, then: Callable[[], None] | None = None) -> None:
        """``then`` is called with the request, by a run that may wait for long."""
        self.signal: int | None = None
        self.then = then
        self._before: dict[int, object] = {}

    def __enter__(self) -> Stopping:
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self._before[number] = signal.signal(number, self._request)
            except ValueError:  # not the main thread: whoever runs us there stops us otherwise
                continue
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)  # type: ignore[arg-type]

    def __call__(self) -> bool:
        """Whether somebody wants us to stop."""
        return self.signal is not None

    def _request(self, number: int, _frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        if self.then is not None:
            self.then()
