"""Single files: written whole, in place of their like and of nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from cluster_slam.errors import OutputError
from cluster_slam.io.map.file import write_file

PAGE = "<!doctype html>\n<title>one</title>\n"


def test_a_page_replaces_an_earlier_page(tmp_path: Path) -> None:
    out = tmp_path / "season.html"
    for text in (PAGE, PAGE.replace("one", "two")):
        write_file(out, text)
        assert out.read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["season.html"]


@pytest.mark.parametrize("there", [b"SQLite format 3\0", b"id,x\n1,2\n", b"\xff\xfe"])
def test_nothing_else_is_replaced(tmp_path: Path, there: bytes) -> None:
    """A map, say, whose name stands where that of the page should: it would be lost."""
    out = tmp_path / "field.map"
    out.write_bytes(there)
    with pytest.raises(OutputError, match=r"field.map: is something else, expected a free name"):
        write_file(out, PAGE)
    assert out.read_bytes() == there


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="cannot be written"):
        write_file(tmp_path / "file" / "page.html", PAGE)


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder, expected a file"):
        write_file(tmp_path, PAGE)
