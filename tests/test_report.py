"""The report: words and figures that can be checked by hand, and the page in a real browser."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser, browser
from made_result import Made, make
from test_evaluation import made_empty

from cluster_slam.evaluation import evaluate
from cluster_slam.geometry import se3_exp
from cluster_slam.records import Calibration, Observations, RejectReason
from cluster_slam.report.colours import PALETTE, colour_indices
from cluster_slam.report.findings import find
from cluster_slam.report.pack import OUTSIDE, box_around, pack
from cluster_slam.report.page import page_json, render_report
from cluster_slam.report.statistics import fit_of, hand_eye_correction, misfit_curve, radius95, sigma, summarise, sway
from cluster_slam.report.summary import headline, sentences
from cluster_slam.report.words import angle, count, digits, duration, length, share

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")


@pytest.fixture(scope="module")
def made() -> Made:
    return make(0, n_frames=120)


# words


@pytest.mark.parametrize(
    ("metres", "text"),
    [
        (0.0, "0 mm"), (2.34e-6, "2.3 µm"), (2.34e-5, "0.023 mm"), (3.4e-4, "0.34 mm"), (0.013, "13 mm"),
        (0.234, "23 cm"), (2.34, "2.3 m"), (1234.0, "1,234 m"), (float("nan"), "unknown"),
    ],
)  # fmt: skip
def test_lengths_have_a_fitting_unit(metres: float, text: str) -> None:
    assert length(metres) == text


def test_other_words() -> None:
    assert angle(np.pi / 360) == "0.50°"
    assert (digits(0.0), digits(0.0123), digits(1234.6)) == ("0", "0.012", "1,235")
    assert (share(1, 3), share(3, 3), share(99999, 100000), share(0, 0)) == ("33 %", "100 %", "99.9 %", "0 %")
    assert (count(1, "flower"), count(1240, "flower")) == ("1 flower", "1,240 flowers")
    assert (duration(12.34), duration(250), duration(7500)) == ("12 s", "4 min 10 s", "2 h 5 min")


# figures


def test_radius_and_sigma_by_hand() -> None:
    covs = np.array([np.diag([1.0, 4.0, 9.0]), 4.0 * np.eye(3)])
    np.testing.assert_allclose(sigma(covs), [np.sqrt(14 / 3), 2.0])
    np.testing.assert_allclose(radius95(covs), np.sqrt(7.814728) * np.array([3.0, 2.0]), rtol=1e-6)


def test_summary_counts(made: Made) -> None:
    summary = summarise(made.result)
    clutter = made.result.flower_ids == -1
    assert (summary.n_clusters, summary.n_single, summary.n_unsure) == (6, 0, 0)
    assert summary.n_rejected == clutter.sum() == sum(n for _, n in summary.rejected)
    assert [n for _, n in summary.rejected] == sorted((n for _, n in summary.rejected), reverse=True)
    assert summary.rejected[0][0] is RejectReason.POSITION_GATE
    assert summary.misfit == pytest.approx(np.nanmean(made.result.diagnostics.nis) / 3)
    assert summary.seconds == pytest.approx(119 / 15)


def test_hand_eye_correction_by_hand(made: Made) -> None:
    given = made.session.T_flange_camera
    assert given is not None
    xi = np.array([0.01, 0.0, 0.0, 0.003, 0.0, 0.004])
    result = replace(made.result, calibration=Calibration(given @ se3_exp(xi), np.eye(6)))
    np.testing.assert_allclose(hand_eye_correction(result), xi, atol=1e-12)
    assert summarise(result).hand_eye_m == pytest.approx(0.005)
    assert hand_eye_correction(replace(made.result, calibration=None)) is None


def test_misfit_curve_holds_all_observations(made: Made) -> None:
    curve = misfit_curve(made.result)
    assert curve.n.sum() == np.isfinite(made.result.diagnostics.nis).sum()
    assert np.average(curve.mean, weights=curve.n) == pytest.approx(np.nanmean(made.result.diagnostics.nis))
    assert 0.85 <= curve.share_inside <= 1.0
    double = replace(made.result, diagnostics=replace(made.result.diagnostics, nis=2 * made.result.diagnostics.nis))
    assert misfit_curve(double).share_inside < 0.05


def test_sway_is_what_was_put_in() -> None:
    still = sway(make(3, n_frames=120, sway_m=0.0).result)
    touched = sway(make(3, n_frames=120, sway_m=0.05).result)
    assert still.largest.max() < 0.012  # one in a thousand of chance displacements counts
    assert touched.largest[0] == pytest.approx(0.05 * np.linalg.norm([0.8, 0.3, 0.5]) * np.exp(-0.2 / 1.5), rel=0.2)
    assert touched.largest[-1] < 0.012


def test_near_clusters_differ_in_colour() -> None:
    rng = np.random.default_rng(1)
    positions = rng.normal(size=(60, 3))
    colours = colour_indices(positions)
    assert set(colours) <= set(range(len(PALETTE)))
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1) + 99 * np.eye(60)
    assert (colours != colours[gaps.argmin(1)]).all()
    assert colour_indices(np.zeros((0, 3))).tolist() == []
    assert colour_indices(np.zeros((1, 3))).tolist() == [0]


def test_packed_arrays_come_back() -> None:
    packed = pack(np.array([[1, 2], [3, 65535]]), "u2")
    assert packed["s"] == [2, 2]
    assert np.frombuffer(base64.b64decode(str(packed["b"])), "<u2").tolist() == [1, 2, 3, 65535]


def test_positions_in_steps() -> None:
    box = box_around(np.array([[0.0, 0, 0], [2.0, 1.0, 0.0]]), margin=0.0)
    points = np.array([[2.0, 0.5, 0.0], [0.0, 1.5, -1.0], [2.1, 0, 0], [np.nan, 0, 0]])
    steps = box.steps(points)
    assert (steps[2:] == OUTSIDE).all()
    np.testing.assert_allclose(box.centre + steps[:2] * box.half / 32000, points[:2], atol=2e-5)


# what it says


def test_headline_and_sentences(made: Made) -> None:
    summary = summarise(made.result)
    assert headline(summary) == f"6 clusters with {len(made.result.flowers)} flowers"
    assert (
        headline(replace(summary, n_single=2)) == f"6 clusters and 2 single flowers, {summary.n_flowers} flowers in all"
    )
    assert headline(replace(summary, n_single=1, n_clusters=0)) == "1 single flower"
    assert headline(replace(summary, n_flowers=0)) == "No flowers were mapped"
    text = " ".join(sentences(made.result, summary))
    assert length(summary.radius95_m or 0) in text
    assert "no flower of the map was near enough" in text


def test_a_good_result_has_nothing_wrong(made: Made) -> None:
    metrics = evaluate(made.result, made.session, made.truth)
    found = find(made.result, summarise(made.result), replace(metrics, cluster_idf1=1.0))
    assert [f for f in found if f.level != "note"] == []


def test_noise_that_grows_with_depth_is_told_at_one_metre(made: Made) -> None:
    found = {"flower": 0.002, "flower_depth": 0.006, "flower_lateral": 0.0016}
    found |= {"flower_power_depth": 2.0, "flower_power_lateral": 1.0}
    result = replace(made.result, diagnostics=replace(made.result.diagnostics, estimated_noise=found))
    rows = {row["key"]: row["name"] for row in page_json(result, None)["noise"]}  # type: ignore[attr-defined]
    assert set(rows) == {"flower", "flower_depth", "flower_lateral"}
    assert rows["flower_depth"] == "the depth of a flower 1 m away"


def test_what_is_wrong_is_said(made: Made) -> None:
    diagnostics = made.result.diagnostics
    bad = replace(
        made.result,
        status="poor",
        warnings=("depth looks like millimetres",),
        diagnostics=replace(diagnostics, nis=4.0 * diagnostics.nis, estimated_noise={"flower": 0.0102, "sway": 1.0}),
        calibration=replace(made.result.calibration, unobserved=("shift along forward",)),
        merged=((30, 12),),
        flower_ids=np.where(np.arange(len(made.result.flower_ids)) % 2, made.result.flower_ids, -1),
    )
    covs = made.result.clusters.covs.copy()
    covs[2] *= 100
    bad = replace(bad, clusters=replace(made.result.clusters, covs=covs, states=("tentative",) + ("confirmed",) * 5))
    found = {f.text: f.level for f in find(bad, summarise(bad), None)}
    text = " ".join(found)
    for part in (
        "calls this result poor",
        "1 cluster could not be confirmed",
        "Depth looks like millimetres.",
        "scatter 2.0 times as much",
        "shift along forward",
        "1 landmark was found twice",
        "of all detections were rejected",
        "Cluster 12 is known to",
        "a flower's position in one picture are 2.0 times",
    ):
        assert part in text
    assert next(iter(found.values())) == "bad"


def test_a_cluster_of_two_is_named(made: Made) -> None:
    nis = np.where(made.result.cluster_ids == 13, 9.0, 1.0) * made.result.diagnostics.nis
    result = replace(made.result, diagnostics=replace(made.result.diagnostics, nis=nis))
    text = " ".join(f.text for f in find(result, summarise(result), None))
    assert re.search(r"Cluster 13 does not hold together: its detections scatter (2\.9|3\.0|3\.1) times", text)
    assert text.count("does not hold together") == 1


def test_fit_by_hand(made: Made) -> None:
    nis = np.full(len(made.result.flower_ids), np.nan)
    labels = np.full(len(nis), -1)
    nis[:5], labels[:5] = [3.0, 9.0, 6.0, 1.0, np.nan], [4, 4, 7, 8, 9]
    result = replace(made.result, diagnostics=replace(made.result.diagnostics, nis=nis))
    fit = fit_of(result, np.array([4, 7, 9]), labels)
    assert fit.n.tolist() == [2, 1, 0]
    np.testing.assert_allclose(fit.misfit, [2.0, 2.0, np.nan])
    np.testing.assert_allclose(fit.inside95, [0.5, 1.0, np.nan])


def test_truth_speaks_up(made: Made) -> None:
    metrics = replace(
        evaluate(made.result, made.session, made.truth),
        n_ghost_clusters=2,
        n_clusters_found=4,
        cluster_idf1=0.9,
        nees_flowers=9.0,
    )
    text = " ".join(f.text for f in find(made.result, summarise(made.result), metrics))
    for part in (
        "2 clusters of the map do not exist",
        "2 of 6 true clusters",
        "10 % of detections",
        "3.0 times further",
    ):
        assert part in text


# the page


def test_page_is_self_contained_and_small(made: Made) -> None:
    page = render_report(made.result, evaluate(made.result, made.session, made.truth))
    assert len(page.encode()) < 1_000_000
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", page)
    assert "default-src 'none'" in page
    assert "{{" not in page.split('id="data"')[0]


def test_names_cannot_break_out_of_the_page(made: Made) -> None:
    evil = "</script><script>alert(1)</script>{{data}}"
    page = render_report(replace(made.result, session=replace(made.session, id=evil), warnings=(evil,)), None)
    assert page.count("<script") == 2
    assert "alert(1)</script>" not in page


def test_json_has_every_part(made: Made) -> None:
    values = page_json(made.result, None)
    scene = values["scene"]
    assert isinstance(scene, dict)
    assert len(scene["clusters"]) == 6
    assert len(scene["flowers"]) == len(made.result.flowers)
    assert json.dumps(values["rejected"])
    assert values["scores"] == []


def test_many_observations_are_thinned_by_frame(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cluster_slam.report.scene.MAX_OBSERVATIONS", int(len(made.session.observations) / 2.5))
    scene = page_json(made.result, None)["scene"]
    assert isinstance(scene, dict)
    assert scene["observations"]["every"] == 3
    kept = scene["observations"]["flower"]["s"][0]
    assert kept == (made.session.observations.frame % 3 == 0).sum()
    assert scene["drift"]["frame"]["s"][0] == (made.result.drift.frame % 3 == 0).sum()


def test_the_largest_session_stays_under_eight_megabytes() -> None:
    big = make(2, n_frames=12_000, n_clusters=12)
    assert len(big.session.observations) > 500_000
    assert len(big.result.drift.frame) > 120_000
    assert len(render_report(big.result, None).encode()) < 8_000_000


def test_empty_result_has_a_page() -> None:
    empty = made_empty()
    page = render_report(empty.result, evaluate(empty.result, empty.session, empty.truth))
    assert "No flowers were mapped" in page


def test_one_picture_makes_no_claims_about_fit() -> None:
    full = make(0, n_frames=30)
    rows = np.flatnonzero((full.session.observations.frame == 3) & (full.result.flower_ids >= 0))
    rows = rows[np.unique(full.result.flower_ids[rows], return_index=True)[1]]
    seen = full.session.observations
    observations = Observations(0 * rows, seen.points[rows], seen.covs[rows], seen.scores[rows])
    T = full.result.T_world_camera[3:4]
    session = replace(
        full.session, stamps=np.zeros(1), poses=T, pose_frame="T_world_camera", T_flange_camera=None,
        observations=observations,
    )  # fmt: skip
    result = replace(
        full.result, session=session, T_world_camera=T, flower_ids=full.result.flower_ids[rows],
        cluster_ids=full.result.cluster_ids[rows], calibration=None,
        diagnostics=replace(full.result.diagnostics, nis=np.zeros(len(rows)), reasons=0 * rows),
        drift=replace(full.result.drift, frame=0 * full.result.drift.frame),
    )  # fmt: skip
    summary = summarise(result)
    assert (summary.misfit, summary.path_shift_m, summary.hand_eye_m) == (None, None, None)
    assert sentences(result, summary)[0].startswith("One picture was taken")
    assert {tile["label"] for tile in page_json(result, None)["tiles"]} == {  # type: ignore[attr-defined]
        "Clusters", "How sure is the map", "Rejected detections",
    }  # fmt: skip
    assert page_json(result, None)["coverage"] == []


# in a browser


@pytest.fixture(scope="module")
def page() -> Iterator[Browser]:
    with browser() as made_browser:
        yield made_browser


def put(folder: Path, made: Made) -> Path:
    path = folder / "report.html"
    path.write_text(render_report(made.result, evaluate(made.result, made.session, made.truth)), encoding="utf-8")
    return path


def colours_in(page: Browser, selector: str) -> int:
    """How many different pixels a canvas has."""
    return int(
        page.value(
            f"(() => {{ const c = document.querySelector('{selector}'); const d = c.getContext('2d')"
            ".getImageData(0, 0, c.width, c.height).data; const s = new Set();"
            " for (let i = 0; i < d.length; i += 4) s.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return s.size; })()"
        )
    )


@needs_browser
def test_opens_from_disk_without_a_request_or_an_error(page: Browser, made: Made, tmp_path: Path) -> None:
    path = put(tmp_path, made)
    page.requests.clear()
    page.open(path)
    assert page.value("document.getElementById('headline').textContent").startswith("6 clusters with ")
    assert page.value("document.querySelectorAll('#clusters tbody tr').length") == 6
    assert colours_in(page, "#scene") > 50
    assert colours_in(page, "#misfit canvas") > 5
    assert [r for r in page.requests if not r.startswith("data:")] == [path.resolve().as_uri()]
    assert page.problems == []


@needs_browser
def test_slider_shows_what_was_seen(page: Browser, made: Made, tmp_path: Path) -> None:
    page.open(put(tmp_path, made))
    before = page.value("document.getElementById('scene').toDataURL()")
    page.click_on("#slider")
    frame = page.value("flowerReport.state.frame")
    assert frame == pytest.approx(60, abs=3)  # the middle of 120 frames
    seen = made.result.flower_ids[made.session.observations.frame == frame]
    words = page.value("document.getElementById('now').textContent")
    assert f"The camera sees {(seen >= 0).sum()} flowers" in words
    assert f"{(seen < 0).sum() or 'nothing'} rejected" in words
    assert page.value("document.getElementById('clock').textContent").startswith(f"{frame / 15:.1f} s")
    assert page.value("document.getElementById('scene').toDataURL()") != before
    page.press("ArrowRight", 39)
    assert page.value("flowerReport.state.frame") == frame + 1
    page.click_on("#whole")
    assert page.value("flowerReport.state.frame") is None
    assert page.problems == []


@needs_browser
def test_slider_of_a_thinned_session(
    page: Browser, made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cluster_slam.report.scene.MAX_OBSERVATIONS", int(len(made.session.observations) / 3.5))
    page.open(put(tmp_path, made))
    page.click_on("#slider")
    frame = page.value("flowerReport.state.frame")
    assert frame % 4 == 0
    seen = made.result.flower_ids[made.session.observations.frame == frame]
    assert f"The camera sees {(seen >= 0).sum()} flowers" in page.value("document.getElementById('now').textContent")
    assert page.problems == []


@needs_browser
def test_a_click_on_a_cluster_tells_its_story(page: Browser, made: Made, tmp_path: Path) -> None:
    page.open(put(tmp_path, made))
    page.value("document.getElementById('scene').scrollIntoView({block: 'center'})")
    x, y = page.value(
        "(() => { const {view, data} = flowerReport; const q = view.project(data.scene.clusters[2].flowers[0].p);"
        " const r = document.getElementById('scene').getBoundingClientRect(); return [r.x + q[0], r.y + q[1]]; })()"
    )
    page.click(x, y)
    chosen = page.value("flowerReport.state.cluster")
    assert chosen is not None
    story = page.value("document.getElementById('detail').innerText")
    assert f"Cluster {10 + chosen}: {made.result.clusters.n_flowers[chosen]} flowers" in story
    accepted = (made.result.cluster_ids == 10 + chosen).sum()
    assert f"{accepted:,} detections accepted" in story
    for flower in made.result.flowers.ids[made.result.flowers.cluster_ids == 10 + chosen]:
        assert str(flower) in story
    assert page.value("document.querySelectorAll('#detail canvas').length") == 3
    assert page.value("document.querySelector('tr[aria-selected=true]').dataset.cluster") == str(chosen)
    assert page.problems == []


@needs_browser
def test_the_table_sorts_and_selects(page: Browser, made: Made, tmp_path: Path) -> None:
    page.open(put(tmp_path, made))
    page.click_on("#clusters th[data-key=n] button")
    shown = page.value("[...document.querySelectorAll('#clusters tbody tr')].map(r => +r.cells[1].textContent)")
    assert shown == sorted(made.result.clusters.n_flowers.tolist())
    page.click_on("#clusters th[data-key=n] button")
    shown = page.value("[...document.querySelectorAll('#clusters tbody tr')].map(r => +r.cells[1].textContent)")
    assert shown == sorted(made.result.clusters.n_flowers.tolist(), reverse=True)
    page.click_on("#clusters tbody tr:first-child")
    assert page.value("document.getElementById('detail').hidden") is False
    page.press("Enter", 13)
    assert page.value("document.getElementById('detail').hidden") is True


@needs_browser
def test_ellipsoids_can_be_magnified_and_play_runs(page: Browser, made: Made, tmp_path: Path) -> None:
    page.open(put(tmp_path, made))
    before = page.value("document.getElementById('scene').toDataURL()")
    page.value("(() => { const m = document.getElementById('magnify'); m.value = '100';"
               " m.dispatchEvent(new Event('change')); })()")  # fmt: skip
    assert page.value("document.getElementById('scene').toDataURL()") != before
    assert "100 times" in page.value("document.getElementById('legend').innerText")
    page.click_on("#play")
    page.wait("flowerReport.state.frame > 3")
    page.click_on("#play")
    assert page.value("flowerReport.state.playing") is False


@needs_browser
@pytest.mark.parametrize(("width", "dark"), [(390, False), (1400, True)])
def test_narrow_and_dark(page: Browser, made: Made, tmp_path: Path, width: int, dark: bool) -> None:
    page.open(put(tmp_path, made), width=width, dark=dark)
    assert page.value("document.documentElement.scrollWidth") <= width
    assert page.value("document.documentElement.dataset.theme") == ("dark" if dark else "light")
    page.click_on("#theme")
    assert page.value("document.documentElement.dataset.theme") == ("light" if dark else "dark")
    assert page.problems == []


@needs_browser
def test_an_empty_result_opens(page: Browser, tmp_path: Path) -> None:
    page.open(put(tmp_path, made_empty()))
    assert page.value("document.getElementById('headline').textContent") == "No flowers were mapped"
    assert page.problems == []
