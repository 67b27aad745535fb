"""Dates as people write them: ISO 8601, UTC where no zone is named, or a weekday."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from cluster_slam.errors import InputError
from cluster_slam.io.text import shown

_DAYS = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")


def seconds(text: str, now: datetime | None = None) -> float:
    """A date as Unix time: ``2026-05-04``, ``2026-05-04T10:30``, seconds, or the latest ``monday``.

    Raises
    ------
    InputError
        It is none of them.
    """
    word = text.strip().lower()
    if word in _DAYS:
        today = (now or datetime.now(UTC)).astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
        return (today - timedelta(days=(today.weekday() - _DAYS.index(word)) % 7)).timestamp()
    try:
        return float(word)
    except ValueError:
        pass
    try:
        when = datetime.fromisoformat(text.strip())
    except ValueError:
        raise InputError(f"date {shown(text)}, expected ISO 8601 as 2026-05-04 or 2026-05-04T10:30") from None
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


def iso(time: float | None) -> str:
    """Unix time as a date and a time of day in UTC; nothing where it is not known."""
    if time is None or time != time:
        return ""
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def minutes(time: float | None) -> str:
    """Unix time as a date and a time of day to the minute, in UTC, for a table."""
    text = iso(time)
    return f"{text[:10]} {text[11:16]}" if text else "no date"
