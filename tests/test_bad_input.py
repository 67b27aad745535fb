"""Every way in which a session can be wrong ends in one line that names file, row, value and expectation."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from folders import CAMERA, COV_HEADER, DETECTIONS, FLOWERS, FLOWERS_COV, LEVEL_2, LEVEL_3, POSES, TOML, write_folder

from cluster_slam.cli.app import run
from cluster_slam.errors import InputError
from cluster_slam.io.session import open_session, open_truth


@dataclass(frozen=True)
class Case:
    """One thing that is wrong, and what the message must hold."""

    name: str
    file: str
    content: str | bytes
    says: tuple[str, ...]  # after the file
    base: dict[str, str] = field(default_factory=lambda: LEVEL_3)


def cov(row: str) -> str:
    return f"{COV_HEADER}\n100.0,0.1,0.2,0.5,0.9,1e-4,0,0,1e-4,0,1e-4\n100.0,0.1,0.2,0.5,0.9,{row}\n"


FLANGE = TOML.replace("T_world_camera", "T_world_flange")
CASES = [
    # flowers.csv
    Case("no column", "flowers.csv", FLOWERS.replace("y,z", "y,depth"), ("row 1", "no column 'z'", "expected")),
    Case("renamed", "flowers.csv", FLOWERS.replace("timestamp", "timestmp"), ("row 1", "is it 'timestmp'?")),
    Case("no header", "flowers.csv", FLOWERS.split("\n", 1)[1], ("row 1", "'100.000000", "expected a header")),
    Case("twice", "flowers.csv", FLOWERS.replace("y,z", "z,z"), ("row 1", "'z' twice", "expected once")),
    Case("NaN", "flowers.csv", FLOWERS.replace("0.25", "nan"), ("row 3", "y is 'nan'", "expected a finite number")),
    Case("infinite", "flowers.csv", FLOWERS.replace("0.6\n", "inf\n"), ("row 4", "z is 'inf'", "finite")),
    Case("word", "flowers.csv", FLOWERS.replace("0.01", "abc"), ("row 4", "x is 'abc'", "expected a finite number")),
    Case("blank cell", "flowers.csv", FLOWERS.replace("0.25", ""), ("row 3", "y is ''", "expected a finite number")),
    Case("empty", "flowers.csv", "", ("row 1", "empty", "expected a header")),
    Case("white", "flowers.csv", "\n\n", ("row 1", "empty", "expected a header")),
    Case("short row", "flowers.csv", FLOWERS.replace(",0.75", ""), ("row 3", "3 values", "expected 4")),
    Case("long row", "flowers.csv", FLOWERS.replace("0.75", "0.75,9"), ("row 3", "5 values", "expected 4")),
    Case("cut off", "flowers.csv", FLOWERS[:-11], ("row 4", "2 values", "expected 4")),
    Case("semicolons", "flowers.csv", FLOWERS.replace(",", ";"), ("row 1", "';'", "expected commas")),
    Case("tabs", "flowers.csv", FLOWERS.replace(",", "\t"), ("row 1", "expected commas")),
    Case("decimal commas", "flowers.csv", FLOWERS.replace("0.5\n", "0,5\n"), ("row 2", "5 values", "expected 4")),
    Case("binary", "flowers.csv", b"\x89PNG\r\n\x1a\n\x00\x00", ("row 1", "0x89", "UTF-8")),
    Case("zero bytes", "flowers.csv", FLOWERS.encode() + b"\0" * 64, ("row 5", "zero byte", "expected text")),
    Case("UTF-16", "flowers.csv", FLOWERS.encode("utf-16"), ("row 1", "UTF-16", "expected UTF-8")),
    Case("Latin-1", "flowers.csv", (FLOWERS + "# é").encode("latin-1"), ("row 5", "0xe9", "expected UTF-8")),
    Case("no frame", "flowers.csv", FLOWERS.replace("100.20", "100.15"), ("row 4", "100.15", "no frame", "expected")),
    Case(
        "other clock", "flowers.csv", FLOWERS.replace("100.200000", "1.7e18"), ("row 4", "1.7e+18", "expected seconds")
    ),
    Case("huge", "flowers.csv", FLOWERS.replace("0.75", "1e300"), ("row 3", "z is 1e+300", "expected metres")),
    Case("not definite", "flowers.csv", cov("1e-4,2e-4,0,1e-4,0,1e-4"), ("row 3", "from -0.0001", "positive definite")),
    Case("flat", "flowers.csv", cov("1e-4,0,0,1e-4,0,0"), ("row 3", "from 0 ", "positive definite")),
    Case("rank two", "flowers.csv", cov("1e-4,1e-4,0,1e-4,0,1e-4"), ("row 3", "positive definite")),
    Case("all zero", "flowers.csv", cov("0,0,0,0,0,0"), ("row 3", "positive definite")),
    Case("negative", "flowers.csv", cov("-1e-4,0,0,-1e-4,0,-1e-4"), ("row 3", "from -0.0001", "positive definite")),
    Case("blank covariance", "flowers.csv", cov("1e-4,,0,1e-4,0,1e-4"), ("row 3", "empty value", "six finite numbers")),
    Case("infinite covariance", "flowers.csv", cov("inf,0,0,1e-4,0,1e-4"), ("row 3", "cov_xx is 'inf'", "finite")),
    Case("half a covariance", "flowers.csv", FLOWERS_COV.replace("cov_zz", "czz"), ("row 1", "cov_zz", "all six")),
    Case("infinite score", "flowers.csv", FLOWERS_COV.replace("0.9,", "inf,"), ("row 2", "score is 'inf'", "finite")),
    # poses.txt
    Case("NaN pose", "poses.txt", POSES.replace("0.5", "nan"), ("row 4", "ty is 'nan'", "expected a finite number")),
    Case("seven values", "poses.txt", POSES.replace("1 0 0 0\n", "1 0 0\n"), ("row 4", "7 values", "expected 8")),
    Case("CSV poses", "poses.txt", POSES.replace(" ", ","), ("row 2", "1 values", "expected 8")),
    Case("same stamp", "poses.txt", POSES.replace("100.20", "100.10"), ("row 4", "100.1 after 100.1", "later")),
    Case("backwards", "poses.txt", POSES.replace("100.20", "100.05"), ("row 4", "100.05 after 100.1", "increasing")),
    Case("nanoseconds", "poses.txt", POSES.replace("100.", "1700000000000100."), ("row 2", "expected seconds")),
    Case("norm 0", "poses.txt", POSES.replace("1 0 0 0\n", "0 0 0 0\n"), ("row 4", "norm 0,", "expected 1")),
    Case("norm 2", "poses.txt", POSES.replace("1 0 0 0\n", "2 0 0 0\n"), ("row 4", "norm 2,", "expected 1")),
    Case("no rows", "poses.txt", "# timestamp tx ty tz qx qy qz qw\n", ("row 1", "no frame", "expected rows")),
    Case("empty poses", "poses.txt", "", ("row 1", "no frame", "expected rows")),
    Case("huge pose", "poses.txt", POSES.replace("0.5", "1e200"), ("row 4", "ty is 1e+200", "expected metres")),
    Case("binary poses", "poses.txt", b"PK\x03\x04\x00\xff", ("row 1", "0xff", "expected UTF-8")),
    Case("cut poses", "poses.txt", POSES[:-8], ("row 4", "values", "expected 8")),
    # session.toml
    Case("wrong format", "session.toml", TOML.replace("format = 1", "format = 2"), ("row 1", "format is '2'", "1")),
    Case(
        "text format", "session.toml", TOML.replace("format = 1", 'format = "1"'), ("row 1", "format is '1'", "expec")
    ),
    Case("no format", "session.toml", TOML.replace("format = 1", ""), ("row 1", "no format", "expected")),
    Case("no id", "session.toml", TOML.replace('id = "small"', ""), ("row 1", "no id", "expected")),
    Case("empty id", "session.toml", TOML.replace('"small"', '""'), ("row 2", "id is ''", "expected")),
    Case(
        "no pose", "session.toml", TOML.replace('pose = "T_world_camera"', ""), ("row 4", "no frames.pose", "expected")
    ),
    Case(
        "pose", "session.toml", TOML.replace("T_world_camera", "T_wc"), ("row 5", "frames.pose is 'T_wc'", "expected")
    ),
    Case("no hand-eye", "session.toml", FLANGE, ("row 5", "T_world_flange", "expected frames.T_flange_camera")),
    Case(
        "short hand-eye",
        "session.toml",
        FLANGE.replace("[noise]", "T_flange_camera = [0, 0, 1]\n[noise]"),
        ("row 6", "frames.T_flange_camera", "at least 7"),
    ),
    Case(
        "hand-eye of norm 0",
        "session.toml",
        FLANGE.replace("[noise]", "T_flange_camera = [0, 0, 1, 0, 0, 0, 0]\n[noise]"),
        ("row 6", "norm 0", "expected 1"),
    ),
    Case(
        "NaN hand-eye",
        "session.toml",
        FLANGE.replace("[noise]", "T_flange_camera = [0, nan, 1, 0, 0, 0, 1]\n[noise]"),
        ("row 6", "T_flange_camera.1 is 'nan'", "expected a finite number"),
    ),
    Case("sigma 0", "session.toml", TOML.replace("0.004", "0.0"), ("row 7", "noise.flower is '0.0'", "greater than 0")),
    Case(
        "sigma word", "session.toml", TOML.replace("0.004", '"5 mm"'), ("row 7", "is '5 mm'", "expected a valid number")
    ),
    Case(
        "pose_error",
        "session.toml",
        TOML.replace("[noise]", 'pose_error = "drift"\n[noise]'),
        ("row 6", "'drift'", "e"),
    ),
    Case("no TOML", "session.toml", TOML.replace("format = 1", "format: 1"), ("row 1", "expected TOML")),
    Case("cut TOML", "session.toml", 'format = 1\nid = "sm', ("row 2", "expected TOML")),
    Case("empty TOML", "session.toml", "", ("row 1", "no format", "expected")),
    Case(
        "frames is no table", "session.toml", 'format = 1\nid = "a"\nframes = 3\n', ("row 3", "frames is '3'", "expec")
    ),
    # level 2
    Case("no v", "detections.csv", DETECTIONS.replace("u,v", "u,w"), ("row 1", "no column 'v'", "expected"), LEVEL_2),
    Case("depth 0", "detections.csv", DETECTIONS.replace("1.0", "0"), ("row 3", "depth is 0", "above 0"), LEVEL_2),
    Case("NaN depth", "detections.csv", DETECTIONS.replace("1.0", "nan"), ("row 3", "depth is 'nan'", "fin"), LEVEL_2),
    Case("no matrix", "camera.yaml", CAMERA.replace("camera_matrix", "K"), ("row 1", "camera_matrix", "data"), LEVEL_2),
    Case("matrix of 2", "camera.yaml", CAMERA.replace("0.0, 320.0,", ""), ("row 4", "7 numbers", "9: fx"), LEVEL_2),
    Case("fx 0", "camera.yaml", CAMERA.replace("400.0", "0.0"), ("row 4", "fx 0", "expected fx > 0"), LEVEL_2),
    Case("matrix of words", "camera.yaml", CAMERA.replace("400.0", "f"), ("row 4", "'[f,", "numbers"), LEVEL_2),
    Case("lens", "camera.yaml", CAMERA.replace("plumb_bob", "fisheye"), ("row 8", "'fisheye'", "plumb_bob"), LEVEL_2),
    Case(
        "more coefficients",
        "camera.yaml",
        CAMERA.replace("data: [0.0, 0.0, 0.0, 0.0, 0.0]", "data: [0, 0, 0, 0, 0, 0.1]"),
        ("row 9", "6 numbers", "expected 5 of plumb_bob"),
        LEVEL_2,
    ),
    Case(
        "beyond the lens",
        "detections.csv",
        DETECTIONS.replace("420,240", "920,240"),
        ("row 2", "u 920", "no inverse"),
        {**LEVEL_2, "camera.yaml": CAMERA.replace("data: [0.0, 0.0, 0.0, 0.0, 0.0]", "data: [-0.5, 0, 0, 0, 0]")},
    ),
    # truth
    Case("truth too short", "truth/observations.csv", "flower_id,cluster_id\n1,1\n", ("1 rows", "expected 3")),
    Case("truth id", "truth/observations.csv", "flower_id,cluster_id\n1,1\n1.5,1\n1,1\n", ("row 3", "1.5", "whole")),
    Case("truth rest", "truth/rest.csv", "flower_id,cluster_id,x,y\n1,1,0,0\n", ("row 1", "no column 'z'", "expected")),
    Case("truth poses", "truth/poses.txt", POSES.replace("1 0 0 0\n", "1 0 0\n"), ("row 4", "7 values", "expected 8")),
]


@pytest.mark.parametrize("case", CASES, ids=[f"{case.file}: {case.name}" for case in CASES])
def test_each_is_one_line_with_file_row_and_expectation(
    tmp_path: Path, case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "session", {**case.base, case.file: case.content})
    with pytest.raises(InputError) as caught:
        open_truth(folder, open_session(folder))
    message = str(caught.value)
    assert message.startswith(str(folder / case.file))
    for part in case.says:
        assert part in message.removeprefix(str(folder / case.file))
    assert run(["smooth", str(folder), "-o", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == f"cluster-slam: {message}\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["session"]


@pytest.mark.parametrize("missing", ["session.toml", "poses.txt", "flowers.csv"])
def test_missing_files(tmp_path: Path, missing: str) -> None:
    folder = write_folder(tmp_path, {name: text for name, text in LEVEL_3.items() if name != missing})
    with pytest.raises(InputError, match=rf"{missing}.*expected"):
        open_session(folder)


def test_camera_missing(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, {name: text for name, text in LEVEL_2.items() if name != "camera.yaml"})
    with pytest.raises(InputError, match=r"camera.yaml: missing, expected camera intrinsics"):
        open_session(folder)


def test_a_folder_where_a_file_should_be(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, {"session.toml": TOML, "flowers.csv": FLOWERS, "poses.txt/x": ""})
    with pytest.raises(InputError, match=r"poses.txt: is a folder, expected"):
        open_session(folder)


def test_a_pipe_where_a_file_should_be(tmp_path: Path) -> None:
    """Nobody need ever write into it: reading would wait for ever."""
    folder = write_folder(tmp_path, {"session.toml": TOML, "flowers.csv": FLOWERS})
    os.mkfifo(folder / "poses.txt")
    with pytest.raises(InputError, match=r"poses.txt: is no file, expected"):
        open_session(folder)


def test_the_session_is_a_file_or_missing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file, expected a session folder"):
        open_session(tmp_path / "file")
    with pytest.raises(InputError, match="missing, expected a session folder"):
        open_session(tmp_path / "nothing")


def test_levels_that_are_not_there(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, {**LEVEL_3, "rgb.txt": "100.0 rgb/1.png\n"})
    with pytest.raises(InputError, match=r"detections.csv: missing, expected as level 2 was asked for"):
        open_session(folder, level=2)
    with pytest.raises(InputError, match=r"level 7, expected"):
        open_session(folder, level=7)
    with pytest.raises(InputError, match=r"images only \(level 1\), expected a detector"):
        open_session(folder, level=1)
