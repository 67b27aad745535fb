"""One file, written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from cluster_slam.errors import OutputError


def write_file(out: Path, text: str) -> None:
    """Write a text file in place of what is there, in one step.

    Raises
    ------
    OutputError
        It cannot be written; what was there is untouched.
    """
    temporary = out.with_name(f".{out.name}.{os.getpid()}.new")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(out)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(f"{out}: cannot be written ({error.strerror}); what was there is untouched") from None
