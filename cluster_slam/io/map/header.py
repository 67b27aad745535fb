"""What a file says before SQLite opens it: is it there, is it of SQLite, and is it all of it?"""

from __future__ import annotations

from pathlib import Path

from cluster_slam.errors import InputError

_MAGIC = b"SQLite format 3\0"


def check_file(path: Path) -> None:
    """Whether a file can be a map at all.

    Raises
    ------
    InputError
        Missing, a folder, no SQLite file, or one that ends in the middle of a page.
    """
    if not path.exists():
        raise InputError(f"{path}: missing, expected a map (`cluster-slam map create {path}` makes one)")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a map (one file)")
    try:
        with path.open("rb") as file:
            begin = file.read(100)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected a map") from None
    if len(begin) < 100 or not begin.startswith(_MAGIC):
        raise InputError(f"{path}: is no map, expected an SQLite file that `cluster-slam map create` made")
    missing = _bytes_missing(path, begin)
    if missing:
        raise InputError(f"{path}: is damaged (its last {missing} bytes are missing), expected the whole file")


def _bytes_missing(path: Path, header: bytes) -> int:
    """Bytes that the last page lacks: SQLite misses whole pages itself, but reads the rest of one as zeros.

    A journal that is still to be brought in may hold that page.
    """
    journal = path.with_name(f"{path.name}-wal")
    if journal.exists() and journal.stat().st_size > 0:
        return 0
    page = int.from_bytes(header[16:18], "big")
    page = 65536 if page == 1 else page
    return -path.stat().st_size % page if page else 0
