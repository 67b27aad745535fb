"""The live picture in the terminal: who is tracked, who is lost, what moves."""

from __future__ import annotations

from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table

    from cluster_slam.online.records import Update

_EVERY_S = 0.2
_ROWS = 24
_COLOURS = {"confirmed": "green", "lost": "red", "tentative": "yellow"}


class TrackView:
    """A table that is drawn anew five times a second, on stderr; a context manager."""

    def __init__(self) -> None:
        self._live: Live | None = None
        self._last = -_EVERY_S
        self._said: list[str] = []

    def __enter__(self) -> TrackView:
        from rich.console import Console
        from rich.live import Live

        self._live = Live(console=Console(stderr=True), auto_refresh=False, transient=True)
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, update: Update) -> None:
        """Show this update, if it is time."""
        self._said = [*self._said, *(f"{r.subject} {r.after} {r.kind}: {r.reason}" for r in update.revisions)][-5:]
        now = monotonic()
        if self._live is not None and now - self._last >= _EVERY_S:
            self._live.update(picture(update, self._said), refresh=True)
            self._last = now


def picture(update: Update, said: list[str]) -> Table:
    """The table of one instant."""
    from rich.table import Table

    tracks = update.tracks
    counts = {state: tracks.states.count(state) for state in ("confirmed", "lost", "tentative")}
    words = ", ".join(f"{n} {state}" for state, n in counts.items())
    table = Table(title=f"{update.stamp:.3f} s   {words}", caption="\n".join(said), caption_justify="left")
    for name in ("cluster", "state", "motion", "flowers", "x m", "y m", "z m", "mm/s", "sigma mm"):
        is_word = name in ("state", "motion")
        table.add_column(
            name, justify="left" if is_word else "right", no_wrap=is_word, min_width=9 if name == "state" else None
        )
    order = sorted(range(len(tracks)), key=lambda j: (-int(tracks.seen[j]), int(tracks.ids[j])))
    for j in [j for j in order if tracks.states[j] != "tentative"][:_ROWS]:
        x, y, z = (f"{v:.3f}" for v in tracks.positions[j])
        speed = 1e3 * float((tracks.velocities[j] ** 2).sum()) ** 0.5
        sigma = 1e3 * float(tracks.covs[j, :3, :3].trace() / 3.0) ** 0.5
        seen = f"{tracks.seen[j]}/{tracks.n_flowers[j]}"
        state = tracks.states[j]
        style = _COLOURS[state]
        table.add_row(
            str(tracks.ids[j]), f"[{style}]{state}[/]", tracks.motions[j], seen, x, y, z, f"{speed:.0f}", f"{sigma:.2f}"
        )
    return table
