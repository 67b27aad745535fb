"""``track --view`` on a real terminal (a pseudo-terminal), and its picture."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import sys
import termios
import time
from pathlib import Path

from cluster_slam.cli.app import run

ESCAPES = re.compile(rb"\x1b\[[0-9;?]*[a-zA-Z]")


def read_all(master: int, process: subprocess.Popen[bytes]) -> bytes:
    """All that a program writes to its terminal until it ends."""
    said, end = b"", time.monotonic() + 120
    while time.monotonic() < end:
        ready, _, _ = select.select([master], [], [], 0.2)
        try:
            new = os.read(master, 65536) if ready else b""
        except OSError:  # the other end is closed
            break
        said += new
        if not new and process.poll() is not None:
            break
    return said


def test_a_live_picture_in_a_real_terminal(tmp_path: Path) -> None:
    session = tmp_path / "session"
    assert run(["simulate", str(session), "--preset", "sample", "--seed", "5", "--set", "duration_s=3", "-q"]) == 0
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (40, 120))
    command = [sys.executable, "-m", "cluster_slam.cli", "track", str(session), "-o", str(tmp_path / "out"), "--view"]
    environment = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "LINES")} | {"TERM": "xterm-256color"}
    process = subprocess.Popen(
        [*command, "--realtime"], stdin=slave, stdout=slave, stderr=slave, env=environment, close_fds=True
    )
    os.close(slave)
    said = read_all(master, process)
    os.close(master)
    assert process.wait(10) == 0, said[-2000:]
    assert b"\x1b[?25l" in said  # the cursor is hidden ...
    assert said.rindex(b"\x1b[?25h") > said.rindex(b"\x1b[?25l")  # ... and comes back
    text = ESCAPES.sub(b"", said).decode()
    pictures = re.findall(r"(\d+\.\d{3}) s +(\d+) confirmed, (\d+) lost", text)
    assert len({stamp for stamp, _, _ in pictures}) >= 5  # it moves
    assert max(int(n) for _, n, _ in pictures) >= 3
    assert "sigma mm" in text
    assert re.search(r"│ +\d+ │ confirmed │ +\w+", text)
    assert "cluster-slam track: ok" in text
    assert (tmp_path / "out" / "report.html").exists()
