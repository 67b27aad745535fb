"""The project as a whole: what a fresh clone promises holds together."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import cluster_slam
from cluster_slam import open_session
from cluster_slam.cli.app import run
from cluster_slam.io.session import open_truth
from cluster_slam.io.tables import read_table

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
PINS = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())

UNLISTED = {"rtde_receive": "ur-rtde"}  # modules that their distribution does not name


def sources() -> list[Path]:
    """All Python files of the two packages."""
    return sorted([*(ROOT / "cluster_slam").rglob("*.py"), *(ROOT / "tracking").rglob("*.py")])


def imported(path: Path) -> set[str]:
    """Top-level modules that a file imports, anywhere in it."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level}
    return {name.split(".")[0] for name in names}


# --- dependencies


def test_exact_versions_are_versions_and_nothing_else() -> None:
    for name, pin in PINS.items():
        assert re.fullmatch(r"[A-Za-z0-9._-]+", name)
        assert re.fullmatch(r"[0-9][0-9A-Za-z.+]*", pin)


def test_exact_versions_lie_in_the_ranges() -> None:
    project = PYPROJECT["project"]
    known = {canonicalize_name(name): pin for name, pin in PINS.items()}
    for text in (*project["dependencies"], *project["optional-dependencies"]["dev"]):
        requirement = Requirement(text)
        if requirement.name != project["name"]:
            assert requirement.specifier.contains(known[canonicalize_name(requirement.name)]), text


def test_all_that_is_imported_is_declared() -> None:
    """Third-party modules of the packages come from distributions that the core, or an extra, names."""
    project = PYPROJECT["project"]
    texts = [*project["dependencies"], *(t for extra in project["optional-dependencies"].values() for t in extra)]
    declared = {canonicalize_name(Requirement(text).name) for text in texts}
    owners = packages_distributions()
    for path in sources():
        for module in imported(path) - sys.stdlib_module_names - {"cluster_slam", "tracking"}:
            names = owners.get(module, [UNLISTED.get(module, module)])  # what an extra brings need not be installed
            assert {canonicalize_name(name) for name in names} & declared, f"{path}: {module}"


def test_pytest_is_not_capped() -> None:
    dev = {Requirement(text).name: Requirement(text) for text in PYPROJECT["project"]["optional-dependencies"]["dev"]}
    assert not any(spec.operator in ("<", "<=", "~=", "==") for spec in dev["pytest"].specifier)


# --- packages


def test_the_version_is_one() -> None:
    assert cluster_slam.__version__ == PYPROJECT["project"]["version"] == version("cluster-slam")
    assert f"## {cluster_slam.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_packages_are_typed() -> None:
    assert (ROOT / "cluster_slam" / "py.typed").is_file()
    assert (ROOT / "tracking" / "py.typed").is_file()


def test_public_calls_are_there() -> None:
    for name in cluster_slam.__all__:
        assert getattr(cluster_slam, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'smoth'"):
        _ = cluster_slam.smoth


def test_tracking_loads_nothing_heavy() -> None:
    modules = ", ".join(f"tracking.{path.stem}" for path in (ROOT / "tracking").glob("[a-z]*.py"))
    heavy = ["gtsam", "cv2", "onnxruntime", "rtde_receive", "cluster_slam"]
    code = f"import sys, {modules}; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# --- pages


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_commands_of_the_pages_exist(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in set(re.findall(r"\bcluster-slam ([a-z][a-z-]*)", page.read_text())) - {"commands"}:
        assert run([words, "--help"]) == 0, words
        capsys.readouterr()


def test_the_targets_of_the_pages_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        assert set(re.findall(r"(?:`|^    )make ([a-z]+)", page.read_text(), re.MULTILINE)) <= targets, page.name


def test_the_library_example_runs(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    code = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    monkeypatch.chdir(ROOT)
    exec(compile(code[0], "README.md", "exec"), {})
    assert len(capsys.readouterr().out.splitlines()) > 6


def test_the_formats_page_names_every_column() -> None:
    from cluster_slam.io import result

    page = (ROOT / "docs" / "formats.md").read_text()
    columns = (result.CLUSTER_COLUMNS, result.FLOWER_COLUMNS, result.DRIFT_COLUMNS, result.OBSERVATION_COLUMNS)
    for header in columns:
        assert f"`{header}`" in page


def test_pictures_are_small() -> None:
    for path in (ROOT / "docs" / "img").iterdir():
        assert path.stat().st_size < 400_000, path.name


# --- data


def test_the_sample_is_small_and_whole() -> None:
    folder = ROOT / "data" / "sample"
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 400_000
    session = open_session(folder)
    truth = open_truth(folder, session)
    assert session.warnings == ()
    assert (session.n_frames, len(session.observations)) == (150, 1680)
    assert truth is not None
    assert truth.flower_ids is not None
    assert (truth.flower_ids < 0).sum() == 23
    assert len(read_table(folder / "truth" / "rest.csv", ("flower_id", "cluster_id"))) == 24


def test_the_sample_is_smoothed_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What ``make demo`` shows."""
    assert run(["smooth", str(ROOT / "data" / "sample"), "-o", str(tmp_path / "demo"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["status"] == "ok"
    assert told["metrics"]["cluster_idf1"] > 0.99
    assert told["metrics"]["clutter_recall"] > 0.95
    assert told["metrics"]["hand_eye_m"] < 0.002
    assert (tmp_path / "demo" / "report.html").stat().st_size < 8_000_000


# --- notebooks


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.name)
def test_notebooks_are_kept_without_outputs(path: Path) -> None:
    cells = json.loads(path.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
