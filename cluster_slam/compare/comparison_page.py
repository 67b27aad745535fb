"""The comparison as a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster_slam.compare.coverage import CoverageRow
from cluster_slam.compare.population import Case
from cluster_slam.compare.recordings import PlantRow, RealRow
from cluster_slam.compare.trial import Outcome
from cluster_slam.reproduce import page


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """All that came out."""

    seed: int
    outcomes: list[Outcome]
    coverage: list[CoverageRow]
    real: list[RealRow]
    plants: list[PlantRow]
    out: Path


def render(done: Comparison, figure: bytes) -> str:
    """The page as HTML, with its figure inside."""
    intro = """Clusters whose flowers lie uniformly in a ball of 3 to 8 cm, no two nearer than 12 mm, each observed
        twice with independent errors. False match rate: share of pairs of different clusters with as many flowers that
        are accepted where 95 % of the true pairs are. Simulated unless said otherwise."""
    parts = [page.paragraph(intro), page.picture(figure, "The comparison in one figure"), *_rates(done.outcomes)]
    return page.page("Descriptors compared", [*parts, *_coverage(done.coverage), *_real(done)])


def case_words(case: Case) -> str:
    """A case in words."""
    words = f"{1000 * case.sigma_m:g} mm, {case.n_flowers} flowers"
    words += f", {case.n_missing} missing" if case.n_missing else ""
    words += f", {case.n_new} new" if case.n_new else ""
    if case.radius_m != Case(0.0, 0).radius_m:
        words += f", radius {100 * case.radius_m[0]:g} to {100 * case.radius_m[1]:g} cm"
    return words


def pivot(outcomes: Sequence[Outcome], value: str, digits: int, factor: float = 1.0) -> list[list[str]]:
    """A row for each case, a column for each descriptor; the header first."""
    names = list(dict.fromkeys(o.name for o in outcomes))
    cases = list(dict.fromkeys(o.case for o in outcomes))
    found = {(o.case, o.name): factor * float(getattr(o, value)) for o in outcomes}
    cells = [[found.get((case, name), np.nan) for name in names] for case in cases]
    text = [["" if np.isnan(x) else f"{x:.{digits}f}" for x in row] for row in cells]
    return [["", *names], *([case_words(case), *row] for case, row in zip(cases, text, strict=True))]


def _rates(outcomes: Sequence[Outcome]) -> list[str]:
    parts = []
    for title, value, digits, factor in (
        ("False matches at 95 % recall, percent", "false_match_rate", 2, 100.0),
        ("Rank 1 in a gallery", "rank_1", 2, 1.0),
        ("Equal error rate, percent", "equal_error_rate", 1, 100.0),
        (
            "Coverage of a nominal 95 % gate, percent",
            "coverage",
            1,
            100.0,
        ),
        ("Time of a comparison, microseconds", "us_per_pair", 1, 1.0),
    ):
        header, *rows = pivot(outcomes, value, digits, factor)
        parts += [page.heading(title), page.table(header, rows)]
    return parts


def _coverage(rows: Sequence[CoverageRow]) -> list[str]:
    names = list(dict.fromkeys(row.name for row in rows))
    cases = list(dict.fromkeys((row.n_flowers, row.radius_in_sigmas) for row in rows))
    found = {(row.n_flowers, row.radius_in_sigmas, row.name): f"{100 * row.coverage:.1f}" for row in rows}
    body = [[f"{n} flowers, {r:g} sigma", *(found.get((n, r, name), "") for name in names)] for n, r in cases]
    text = """Both observations are noisy. A gate that knows only the reference's covariance holds far less than it
        says; near 3 sigma members are taken for one another, which makes the full geometry hold more."""
    return [page.heading("Coverage over the radius"), page.paragraph(text), page.table(["", *names], body)]


def _real(done: Comparison) -> list[str]:
    if not done.real:
        return [page.heading("Real flowers"), page.paragraph("No recordings were given.")]
    body = []
    for row in done.real:
        group = f"{row.n_flowers} neighbours, {row.n_groups} groups"
        body.append([group, row.name, f"{100 * row.false_match_rate:.2f}", f"{row.rank_1:.2f}"])
    parts = [
        page.heading("Real flowers"),
        page.paragraph("Groups of neighbouring flowers of real strawberry plants, errors of 7.5 mm simulated twice."),
        page.table(("groups", "descriptor", "false matches [%]", "rank 1"), body),
    ]
    if done.plants:
        plants = [
            [r.plant, r.n_labels, r.n_detections, r.best_plant, r.n_matched, f"{r.gain:.1f}", f"{r.next_gain:.1f}"]
            for r in done.plants
        ]
        header = ("plant", "labels", "detections", "best fit", "matched flowers", "gain", "gain of the next best")
        text = """What a real detector saw, false detections included, held against the labels of all plants by the full
            geometry with missing and new flowers. Gain: what matching saves, in units of the squared distance."""
        parts += [page.paragraph(text), page.table(header, plants)]
    return parts
