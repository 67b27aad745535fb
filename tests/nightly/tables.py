"""Tables of figures: each test adds its rows, in Markdown, to ``out/nightly/``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

OUT = Path(__file__).parents[2] / "out" / "nightly"


@dataclass(slots=True)
class Tables:
    """Call it with a table's name and a row's columns: the row is printed, and written into that table's file."""

    begun: set[str] = field(default_factory=set)

    def __call__(self, table: str, **columns: object) -> None:
        OUT.mkdir(parents=True, exist_ok=True)
        is_new = table not in self.begun
        with (OUT / f"{table}.md").open("w" if is_new else "a", encoding="utf-8") as file:
            if is_new:
                file.write(_row(name.replace("_", " ") for name in columns) + _row("---" for _ in columns))
            file.write(_row(_text(value) for value in columns.values()))
        self.begun.add(table)
        print(f"\n{table} | " + " | ".join(f"{name} {_text(value)}" for name, value in columns.items()))  # noqa: T201


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |\n"


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
