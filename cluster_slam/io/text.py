"""Text files as they come from elsewhere: byte order marks, line ends of all systems, and what is no text at all."""

from __future__ import annotations

from pathlib import Path

from cluster_slam.errors import InputError

SHOWN = 40  # characters of a value that a message shows


def read_text(path: Path, what: str) -> str:
    """The text of a file with ``\\n`` line ends and without a byte order mark.

    Parameters
    ----------
    path
        The file.
    what
        What it should hold, in words, for the message where it is missing.

    Raises
    ------
    InputError
        The file is missing, a folder, a pipe that nobody need ever fill, unreadable, or not UTF-8 text.
    """
    if path.exists() and not path.is_file() and not path.is_dir() and path.parts[:2] != ("/", "dev"):
        raise InputError(f"{path}: is no file, expected {what}")  # the shell's own pipes are in /dev
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: missing, expected {what}") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, expected {what}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected {what}") from None
    return _decode(path, data).replace("\r\n", "\n").replace("\r", "\n")


def _decode(path: Path, data: bytes) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path}: row 1: UTF-16 text, expected UTF-8")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data[: error.start].count(b"\n") + 1
        raise InputError(f"{path}: row {row}: byte 0x{data[error.start]:02x}, expected UTF-8 text") from None
    if "\0" in text:
        row = text[: text.index("\0")].count("\n") + 1
        raise InputError(f"{path}: row {row}: a zero byte, expected text; the file looks binary or damaged")
    return text


def shown(value: object) -> str:
    """A value as a message shows it: quoted and not too long, on one line."""
    text = repr(str(value))
    return text if len(text) <= SHOWN else text[: SHOWN - 4] + "...'"
