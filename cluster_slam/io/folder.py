"""Folders that are written whole or not at all.

A new folder is filled beside its place under a hidden name and then moved there in one step. Whoever is killed on the
way leaves the former folder, or none, and a hidden one that the next run clears away.
"""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from cluster_slam.errors import OutputError

_AT_FDCWD = -100
_RENAME_EXCHANGE = 2


def check_writable(out: Path) -> None:
    """Refuse a place where no folder can be made, before any work is done; nothing is left there.

    Raises
    ------
    OutputError
        Names the folder and what stands in the way.
    """
    target = Path(os.path.realpath(out))
    if os.path.lexists(out) and not target.exists():
        raise OutputError(f"{out}: a link to nothing, expected a folder or a free name")
    if target.exists() and not target.is_dir():
        raise OutputError(f"{out}: is a file, expected a folder or a free name")
    if os.path.ismount(target):
        raise OutputError(f"{out}: a mounted disk's root cannot be replaced as a whole, expected a folder in it")
    ancestor = target.parent
    while not ancestor.exists():
        ancestor = ancestor.parent
    probe = _hidden(ancestor / target.name, "probe")
    try:
        probe.mkdir()
        probe.rmdir()
    except OSError as error:
        raise OutputError(f"{out}: cannot be written in {ancestor} ({error.strerror})") from None


def recover(out: Path) -> None:
    """Put back what a killed run moved aside, and clear away what it left half-written."""
    target = Path(os.path.realpath(out))
    for left in sorted(target.parent.glob(f".{_escaped(target.name)}.*.*.*")) if target.parent.is_dir() else []:
        pid, _, role = left.name[len(target.name) + 2 :].split(".")
        if role not in ("new", "old") or not pid.isdecimal() or _is_alive(int(pid)):
            continue
        if role == "old" and not target.exists():
            left.rename(target)
        else:
            shutil.rmtree(left, ignore_errors=True)


def write_folder(out: Path, files: Mapping[str, str | bytes]) -> None:
    """Write a folder with these files in place of what is there.

    Parameters
    ----------
    out
        Absent, empty, or a folder that may be replaced (the caller has checked that).
    files
        Content by name, which may lead into one folder below (``truth/poses.txt``); text becomes UTF-8.

    Raises
    ------
    OutputError
        The disk is full, a permission is missing: what was there is untouched.
    """
    target = Path(os.path.realpath(out))
    new = _hidden(target, "new")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        new.mkdir()
        for name, content in files.items():
            (new / name).parent.mkdir(exist_ok=True)
            _write(new / name, content.encode() if isinstance(content, str) else content)
        _sync(new)
        _replace(new, target)
        _sync(target.parent)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); what was there is untouched") from None
    finally:
        shutil.rmtree(new, ignore_errors=True)


def _hidden(target: Path, role: str) -> Path:
    return target.parent / f".{target.name}.{os.getpid()}.{secrets.token_hex(4)}.{role}"


def _escaped(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _replace(new: Path, target: Path) -> None:
    """Move ``new`` to ``target``; what was there ends under the hidden name, or is gone if it was empty."""
    if not target.exists() or not any(target.iterdir()):
        new.rename(target)
    elif not _exchange(new, target):
        old = _hidden(target, "old")
        target.rename(old)
        try:
            new.rename(target)
        except OSError:
            old.rename(target)
            raise
        shutil.rmtree(old, ignore_errors=True)


def _exchange(a: Path, b: Path) -> bool:
    """Swap two folders in one step (Linux, ``renameat2``); False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    status: int = call(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    return status == 0
