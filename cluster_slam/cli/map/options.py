"""What the commands of the map share: their arguments, a map that is open, and tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cluster_slam.cli.summary import print_json
from cluster_slam.errors import ClusterSlamError, ConfigError, InputError

if TYPE_CHECKING:
    from cluster_slam.io.map.store import MapStore

MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="The map: one file.", show_default=False)]
ResultArgument = Annotated[Path, typer.Argument(metavar="RESULT", help="Result folder.", show_default=False)]
AlignOption = Annotated[
    str, typer.Option("--align", metavar="KIND", help="rigid, or similarity: a scale of 0.9 to 1.1 as well.")
]
PlantOption = Annotated[
    str | None, typer.Option("--plant", metavar="NAME", help="Only this plant.", show_default=False)
]


@contextmanager
def opened(path: Path) -> Iterator[MapStore]:
    """A map, closed again at the end; what it takes to read one is imported only now.

    Raises
    ------
    InputError
        Something else went wrong, and the map turns out to be damaged.
    """
    from cluster_slam.io.map import open_map
    from cluster_slam.io.map.check import problems

    with open_map(path) as store:
        try:
            yield store
        except (ValueError, TypeError, LookupError, ArithmeticError) as error:
            found = [] if isinstance(error, ClusterSlamError) else problems(store)
            if found:
                raise InputError(f"{path}: is damaged ({found[0]}); `cluster-slam map check` says more") from error
            raise


def is_similarity(align: str) -> bool:
    """Whether the unit of length may differ.

    Raises
    ------
    ConfigError
        The word is neither of the two.
    """
    if align not in ("rigid", "similarity"):
        raise ConfigError(f"--align {align!r}, expected rigid or similarity")
    return align == "similarity"


def tell(title: str, value: dict[str, Any], rows: Iterable[tuple[str, str]], *, quiet: bool, as_json: bool) -> None:
    """One JSON object, or a title and names with values, or nothing."""
    if as_json:
        print_json(value)
    elif not quiet:
        print_columns(title, (), rows)


def print_columns(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A title on a line of its own, however narrow the table, and the table below it."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    rows = [tuple(row) for row in rows]
    table = Table(show_header=bool(header))
    for k in range(len(rows[0]) if rows else len(header)):
        name = header[k] if header else ""
        table.add_column(name, style="bold" if k == 0 else None, overflow="fold")
    for row in rows:
        table.add_row(*row)
    console.print(title, style="italic", highlight=False, markup=False)
    if rows:
        console.print(table)
