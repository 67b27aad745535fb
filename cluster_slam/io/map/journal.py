"""What a session changed in a map, packed, so that it can be taken out again."""

from __future__ import annotations

import json
import zlib
from typing import Any

PARTS = {"plant", "clusters", "flowers"}


def packed(journal: dict[str, Any]) -> bytes:
    """Rows as they were before a session; of rows that it brought only the id."""
    return zlib.compress(json.dumps(journal).encode(), 6)


def unpacked(before: bytes) -> dict[str, Any]:
    """The rows again.

    Raises
    ------
    ValueError
        They are damaged.
    """
    try:
        journal: Any = json.loads(zlib.decompress(before))
    except (zlib.error, ValueError, TypeError) as error:
        raise ValueError(str(error)) from None
    if not (isinstance(journal, dict) and set(journal) >= PARTS):
        raise ValueError(f"expected {', '.join(sorted(PARTS))}")
    return journal
