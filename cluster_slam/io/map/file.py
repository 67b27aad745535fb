"""One file, written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from cluster_slam.errors import OutputError

_BEGINNING = 1000  # bytes that tell what a file is


def write_file(out: Path, text: str) -> None:
    """Write a text file in place of what is there, in one step.

    Raises
    ------
    OutputError
        It cannot be written, or what is there is no file of this kind, by its beginning; it is untouched.
    """
    _refuse_foreign(out, text)
    temporary = out.with_name(f".{out.name}.{os.getpid()}.new")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(out)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise OutputError(f"{out}: cannot be written ({error.strerror}); what was there is untouched") from None


def _refuse_foreign(out: Path, text: str) -> None:
    """A page replaces an earlier page, a table one with the same columns, and nothing else."""
    if out.is_dir():
        raise OutputError(f"{out}: is a folder, expected a file or a free name")
    if not out.is_file() or out.stat().st_size == 0:
        return
    with out.open("rb") as file:
        there = file.read(_BEGINNING)
    if there.split(b"\n")[0].strip() != text.encode("utf-8")[:_BEGINNING].split(b"\n")[0].strip():
        raise OutputError(f"{out}: is something else, expected a free name or an earlier file of this kind")
