"""The command line: quick help, what each command prints, exit codes, and one line for whatever goes wrong."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from folders import LEVEL_3, write_folder
from made_result import make

from cluster_slam.cli.app import main, run
from cluster_slam.cli.options import configured
from cluster_slam.cli.progress import StageProgress
from cluster_slam.cli.smooth import smooth_config
from cluster_slam.cli.summary import shown_metric
from cluster_slam.config import GroupingConfig, MapConfig, SmoothConfig
from cluster_slam.errors import ConfigError
from cluster_slam.io.session import open_session
from cluster_slam.io.session_writer import write_session
from cluster_slam.records import Result, Session
from cluster_slam.simulate import PRESETS, SimulateConfig, simulate_session

MADE = make(3, n_frames=60)
HEAVY = ["numpy", "scipy", "gtsam", "cv2", "plotly", "matplotlib", "filterpy", "onnxruntime", "rich"]
COMMANDS = ["smooth", "simulate", "evaluate", "check", "figures", "compare-descriptors", "reproduce paper"]
Smooth = Callable[..., Result]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    write_session(tmp_path / "session", MADE.session, MADE.truth)
    return tmp_path / "session"


@pytest.fixture
def smoother(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """``smooth`` replaced by one that gives the made result; its arguments and how it ends are in the dict."""
    told: dict[str, Any] = {"status": "ok", "warnings": (), "raises": None}

    def smooth(session: Session, *, config: SmoothConfig, seed: int = 0, progress: Any = None) -> Result:
        told.update(config=config, seed=seed)
        progress("associating", 0.5)
        if told["raises"] is not None:
            raise told["raises"]
        return replace(MADE.result, session=session, status=told["status"], warnings=told["warnings"])

    module = ModuleType("cluster_slam.pipeline.smooth")
    module.smooth = smooth  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cluster_slam.pipeline.smooth", module)
    return told


# --- help


def test_nothing_heavy_is_imported() -> None:
    code = f"import sys, cluster_slam.cli; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("command", [[], *(name.split() for name in COMMANDS)], ids=["all", *COMMANDS])
def test_help_imports_nothing_heavy(command: list[str]) -> None:
    code = f"""
import sys
from cluster_slam.cli.app import run
code = run({[*command, "--help"]})
print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)
sys.exit(code)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    assert "Example: cluster-slam" in done.stdout or not command


def test_no_arguments_is_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([]) == 0
    bare = capsys.readouterr().out
    assert run(["--help"]) == 0
    assert capsys.readouterr().out == bare
    assert run(["map"]) == 0
    assert "  create " in capsys.readouterr().out
    for name in COMMANDS:
        assert re.search(rf"^  {name.split()[0]} +[A-Z].*[^.][.]$", bare, re.MULTILINE)


def test_help_is_as_quick_as_its_library() -> None:
    """A ratio of the processor's time: half a second on a quiet machine is about four bare imports of typer."""

    def least(*arguments: str) -> float:
        seconds = []
        for _ in range(5):
            before = os.times()
            subprocess.run([sys.executable, *arguments], capture_output=True, check=True)
            after = os.times()
            seconds.append(sum(after[2:4]) - sum(before[2:4]))
        return min(seconds)

    assert least("-m", "cluster_slam.cli", "smooth", "--help") < 6.0 * least("-c", "import typer")


def test_the_console_script_is_there() -> None:
    script = Path(sys.executable).parent / "cluster-slam"
    done = subprocess.run([script, "--version"], capture_output=True, text=True, check=True)
    assert re.fullmatch(r"cluster-slam \d+\.\d+\.\d+\n", done.stdout)


# --- smooth


def test_smooth_writes_a_result_and_tells_about_it(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), "--seed", "4"]) == 0
    printed = capsys.readouterr().out
    for word in ("frames", "60", "clusters", "clutter", "hand-eye", "IDF1 of clusters 0.", "report.html"):
        assert word in printed
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {"trajectory.txt", "observations.csv", "clusters.csv", "flowers.csv", "drift.csv"}
    assert names >= {"calibration.toml", "run.json", "metrics.json", "report.html"}
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (record["seed"], smoother["seed"]) == (4, 4)
    assert record["config"]["grouping"]["method"] == "spacing"
    assert record["timings_s"].keys() >= {"read", "evaluate", "report", "smooth"}
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics.keys() >= {"ate_rmse_m", "cluster_idf1", "flower_hota", "nees_flowers", "hand_eye_rad"}


def test_json_and_nothing_else(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), "--json"]) == 0
    printed = capsys.readouterr()
    record = json.loads(printed.out)
    assert record.pop("metrics") == json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert record.pop("out") == str(tmp_path / "out")
    assert record == json.loads((tmp_path / "out" / "run.json").read_text())
    assert printed.err == ""


def test_quiet(session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    smoother["warnings"] = ("odd",)
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_a_poor_result_is_written_and_says_why(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    smoother.update(status="poor", warnings=("all observations are clutter",))
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), "--quiet"]) == 1
    assert capsys.readouterr().err == "warning: the result is poor: all observations are clutter\n"
    assert json.loads((tmp_path / "out" / "run.json").read_text())["status"] == "poor"


def test_without_truth_there_are_no_metrics(smoother: dict[str, Any], tmp_path: Path) -> None:
    write_session(tmp_path / "session", MADE.session)
    assert run(["smooth", str(tmp_path / "session"), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    assert not (tmp_path / "out" / "metrics.json").exists()


def test_warnings_of_the_session_reach_the_record(smoother: dict[str, Any], session: Path, tmp_path: Path) -> None:
    with (session / "session.toml").open("a") as file:
        file.write("[site]\nname = 'x'\n")
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    (warning,) = json.loads((tmp_path / "out" / "run.json").read_text())["warnings"]
    assert "unknown key site" in warning


def test_the_output_is_checked_before_any_work(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["smooth", str(session), "-o", str(session)]) == 2
    assert "holds flowers.csv but no run.json" in capsys.readouterr().err
    assert "config" not in smoother


def test_options_reach_the_method(session: Path, smoother: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "options.toml").write_text("max_rounds = 5\n[grouping]\nlinkage_m = 0.1\n")
    arguments = ["--config", str(tmp_path / "options.toml"), "--set", "max_rounds=2", "--clusters", "7", "--quiet"]
    assert run(["smooth", str(session), "-o", str(tmp_path / "out"), *arguments]) == 0
    expected = replace(SmoothConfig(), max_rounds=2, grouping=GroupingConfig("kmeans", 7, linkage_m=0.1))
    assert smoother["config"] == expected


# --- options


def test_settings_are_toml_or_words() -> None:
    assert configured(SmoothConfig(), None, ["max_rounds=9", "grouping.method=branch"]) == replace(
        SmoothConfig(), max_rounds=9, grouping=GroupingConfig("branch")
    )
    assert configured(SimulateConfig(), None, ["n_clusters = 3"]).n_clusters == 3


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("max_round=1", "unknown option max_round; did you mean max_rounds?"),
        ("grouping.metod=none", "unknown option grouping.metod; did you mean grouping.method?"),
        ("grouping.method=magic", "option grouping.method is 'magic', expected 'spacing', 'kmeans'"),
        ("grouping.n_clusters=many", "option grouping.n_clusters is 'many', expected a valid integer"),
        ("max_rounds=1.5", "option max_rounds wants int, not 1.5"),
        ("max_rounds", "expected KEY=VALUE"),
        ("=3", "expected KEY=VALUE"),
        ("grouping=3", "option grouping wants a table"),
        ("outlier_probability=nan", "option outlier_probability wants a finite number, not nan"),
        ("outlier_probability=2", "option outlier_probability wants a number from 0 to 1, not 2.0"),
        ("outlier_probability=1", "option outlier_probability wants a number between 0 and 1, not 1.0"),
        ("follow.reach_m=-1", "option follow.reach_m wants a number from 0, not -1.0"),
        ("grouping.linkage_m=-1", "option grouping.linkage_m wants a number from 0, not -1"),
        ("particles.n_particles=0", "option particles.n_particles wants a number from 1, not 0"),
    ],
)
def test_wrong_settings(setting: str, says: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(says)):
        configured(SmoothConfig(), None, [setting])


def test_nothing_may_be_wanted_where_that_means_something() -> None:
    assert configured(SmoothConfig(), None, ["particles.n_redo=0"]).particles.n_redo == 0
    assert configured(SimulateConfig(), None, ["n_leaves=0"]).n_leaves == 0
    assert configured(MapConfig(), None, ["growth.size_per_day=-0.01"]).growth.size_per_day == -0.01


def test_kmeans_and_the_number_of_clusters_come_together() -> None:
    assert smooth_config(None, [], None, 3).grouping == GroupingConfig("kmeans", 3)
    for grouping, clusters in (("kmeans", None), ("spacing", 3)):
        with pytest.raises(ConfigError, match="expected a number of clusters with kmeans, and only there"):
            smooth_config(None, [], grouping, clusters)


def test_a_configuration_that_is_no_toml(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("max_rounds: 1")
    with pytest.raises(ConfigError, match=r"a.toml: .*, expected TOML"):
        configured(SmoothConfig(), tmp_path / "a.toml", [])


@pytest.mark.parametrize("line", ["max_rounds = -1", "max_round = 3", "[grouping]\nmethod = 'magic'"])
def test_a_wrong_option_of_a_file_names_the_file(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.toml").write_text(line)
    with pytest.raises(ConfigError, match=r"a.toml: .*option"):
        configured(SmoothConfig(), tmp_path / "a.toml", [])


# --- simulate, evaluate, check


def test_simulate_writes_a_session(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--preset", "sample", "--seed", "2", "--set", "duration_s=2.0", "--json"]
    for name in ("a", "b"):
        assert run(["simulate", str(tmp_path / name), *arguments]) == 0
    first, second = ((tmp_path / name / "flowers.csv").read_bytes() for name in ("a", "b"))
    assert first == second
    capsys.readouterr()
    assert run(["check", str(tmp_path / "a"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["level"] == 3
    assert facts["duration_s"] == pytest.approx(2.0, abs=0.1)


def test_simulate_does_not_replace_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "s", LEVEL_3)
    assert run(["simulate", str(folder), "--preset", "sample"]) == 2
    assert "holds the session 'small', which is not simulated" in capsys.readouterr().err
    assert sorted(path.name for path in folder.iterdir()) == sorted(LEVEL_3)


def test_level_2_of_the_simulation_is_lifted_to_where_it_was(tmp_path: Path) -> None:
    settings = ["--preset", "sample", "--set", "duration_s=1.0", "--set", "level=2", "--quiet"]
    assert run(["simulate", str(tmp_path / "s"), *settings]) == 0
    seen = open_session(tmp_path / "s").observations
    made = simulate_session(replace(PRESETS["sample"], duration_s=1.0, level=2), seed=0).session.observations
    np.testing.assert_allclose(seen.points, made.points, atol=1e-9)
    np.testing.assert_allclose(seen.covs, made.covs, rtol=1e-6, atol=1e-13)


def test_unknown_presets_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["simulate", str(tmp_path / "a"), "--preset", "moderat"]) == 2
    assert "unknown preset 'moderat'; did you mean moderate? (known: moderate, hard" in capsys.readouterr().err


def test_evaluate_prints_the_metrics_that_smooth_wrote(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["smooth", str(session), "-o", str(out), "--quiet"]) == 0
    assert run(["evaluate", str(out), str(session), "--json"]) == 0
    found, written = json.loads(capsys.readouterr().out), json.loads((out / "metrics.json").read_text())
    assert found == pytest.approx(written, rel=1e-5, abs=1e-9)
    assert run(["evaluate", str(out), str(session)]) == 0
    assert "flower_idf1" in capsys.readouterr().out


def test_evaluate_without_truth(smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_session(tmp_path / "session", MADE.session)
    assert run(["smooth", str(tmp_path / "session"), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    assert run(["evaluate", str(tmp_path / "out"), str(tmp_path / "session")]) == 2
    assert "truth: missing, expected ground truth" in capsys.readouterr().err


def test_figures_find_the_session_by_themselves(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, pictures = tmp_path / "out", tmp_path / "pictures"
    assert run(["smooth", str(session), "-o", str(out), "--quiet"]) == 0
    assert run(["figures", str(out), "-o", str(pictures), "--formats", "svg", "--json"]) == 0
    paths = json.loads(capsys.readouterr().out)["figures"]
    assert paths
    assert sorted(paths) == sorted(str(path) for path in pictures.iterdir())
    assert run(["figures", str(out), "-o", str(out / "figures")]) == 2
    assert "inside of the result" in capsys.readouterr().err
    session.rename(tmp_path / "moved")
    assert run(["figures", str(out), "-o", str(tmp_path / "more"), "--formats", "svg"]) == 0
    assert "is not there, so figures lack" in capsys.readouterr().err


@pytest.mark.parametrize(("is_exact", "alpha", "code"), [(True, 1.0, 0), (False, 1.0, 1), (False, 0.5, 0)])
def test_reproduce_says_whether_the_table_is_exact(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], is_exact: bool, alpha: float, code: int
) -> None:
    def reproduce(out: Path, **options: Any) -> SimpleNamespace:
        assert (options["alpha"], options["noise"]) == (alpha, 0.01)
        return SimpleNamespace(is_table1_exact=is_exact, settings=SimpleNamespace(is_paper=alpha == 1.0))

    monkeypatch.setattr("cluster_slam.reproduce.paper.reproduce_paper", reproduce)
    assert run(["reproduce", "paper", "-o", "x", "--alpha", str(alpha), "--json"]) == code
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"out": "x", "is_table1_exact": is_exact}
    assert ("not as printed" in printed.err) == (code == 1)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("ate_rmse_m", 0.00123, "1.23 mm"),
        ("ate_rmse_m", 1.99, "1.99 m"),
        ("hand_eye_rad", 0.0174533, "1 deg"),
        ("cluster_idf1", 0.99981, "0.9998"),
    ],
)
def test_metrics_are_shown_with_their_unit(name: str, value: float, text: str) -> None:
    assert shown_metric(name, value) == text


def test_check_says_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path, {**LEVEL_3, "truth/poses.txt": LEVEL_3["poses.txt"]})
    assert run(["check", str(folder), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts == {
        "id": "small",
        "plant": "row3",
        "level": 3,
        "frames": 3,
        "duration_s": 0.2,
        "rate_hz": 10.0,
        "poses": "T_world_camera, absolute",
        "observations": 3,
        "observations_per_frame": 1.0,
        "covariances": "from the stated sigma",
        "scores": "none",
        "distance_m": "0.548 to 0.797",
        "median_sigma_m": 0.004,
        "truth": "poses",
        "warnings": [],
    }
    assert run(["check", str(folder)]) == 0
    assert "observations per frame" in capsys.readouterr().out


# --- how it ends


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["smooth"], "Missing argument"),
        (["smooth", "x"], "Missing option '--out' / '-o'"),
        (["smooth", "x", "-o", "y", "--sed", "3"], "No such option: --sed"),
        (["smooth", "x", "-o", "y", "--seed", "a"], "Invalid value for '--seed'"),
        (["reproduce"], "Missing command"),
        (["smoth"], "No such command 'smoth'"),
    ],
)
def test_wrong_usage_is_one_line(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(arguments) == 2
    printed = capsys.readouterr()
    assert says in printed.err
    assert printed.err.count("\n") == 1
    assert "--help)" in printed.err


def test_interrupted(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    smoother["raises"] = KeyboardInterrupt()
    assert run(["smooth", str(session), "-o", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "cluster-slam: interrupted; nothing has been written\n"
    assert not (tmp_path / "out").exists()


def test_a_bug_is_one_line_unless_asked(
    session: Path, smoother: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    smoother["raises"] = ZeroDivisionError("by\nzero")
    arguments = ["smooth", str(session), "-o", str(tmp_path / "out")]
    assert run(arguments) == 70
    line = capsys.readouterr().err
    assert re.fullmatch(
        r"cluster-slam: a bug in cluster-slam, ZeroDivisionError at test_cli.py:\d+: by zero .*\n", line
    )
    with pytest.raises(SystemExit) as end:
        main(["--debug", *arguments])
    assert end.value.code == 70
    assert "Traceback" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_reader_that_goes_away_is_no_error(session: Path) -> None:
    code = "import sys; from cluster_slam.cli import main; main(['check', sys.argv[1], '--json'])"
    piped = f'"{sys.executable}" -c "{code}" "{session}" | true; exit ${{PIPESTATUS[0]}}'
    done = subprocess.run(["bash", "-c", piped], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_progress_shows_after_its_delay_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("cluster_slam.cli.progress.DELAY_S", 0.05)
    with StageProgress(is_shown=True) as progress:
        progress("reading", 0.1)
        assert progress._progress is None
        time.sleep(0.3)
        progress("smoothing", 0.6)
        assert progress._progress is not None
        (task,) = progress._progress.tasks
        assert (task.description, task.completed) == ("smoothing", 0.6)
    with StageProgress(is_shown=False) as silent:
        time.sleep(0.1)
        assert silent._progress is None
