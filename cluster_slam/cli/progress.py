"""A progress bar on stderr for work that takes longer than two seconds."""

from __future__ import annotations

import sys
import threading
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

DELAY_S = 2.0  # shorter work shows no bar


class StageProgress:
    """Call it with a stage in words and the fraction done (0 to 1); use it as a context manager.

    The bar is drawn on a terminal only, and cleared when the work ends.
    """

    def __init__(self, *, is_shown: bool) -> None:
        self._stage = ""
        self._fraction = 0.0
        self._lock = threading.Lock()
        self._progress: Progress | None = None
        self._task: TaskID | None = None
        self._is_open = True
        self._timer = threading.Timer(DELAY_S, self._show) if is_shown and sys.stderr.isatty() else None

    def __enter__(self) -> StageProgress:
        if self._timer is not None:
            self._timer.daemon = True
            self._timer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._timer is not None:
            self._timer.cancel()
        with self._lock:
            self._is_open = False
            if self._progress is not None:
                self._progress.stop()

    def __call__(self, stage: str, fraction: float) -> None:
        """Say what is done now and how far it is."""
        with self._lock:
            self._stage, self._fraction = stage, min(max(fraction, 0.0), 1.0)
            self._draw()

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

        with self._lock:
            if not self._is_open:
                return
            columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
            self._progress = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._progress.add_task("working", total=None)
            self._draw()
            self._progress.start()

    def _draw(self) -> None:
        """The bar as things stand; it only pulses as long as no fraction is known."""
        if self._progress is not None and self._task is not None:
            total = 1.0 if self._fraction > 0 else None
            self._progress.update(
                self._task, description=self._stage or "working", completed=self._fraction, total=total
            )
