"""The page of a localised session: its figures and its picture, in one file that opens offline."""

from __future__ import annotations

import html
from collections.abc import Sequence
from importlib import resources

import numpy as np

from cluster_slam.records import SessionLocalisation

REASONS = {
    "ambiguous": "several poses explain what was seen",
    "too_few": "too few clusters or flowers to be sure",
    "no_match": "nothing of the map explains what was seen",
}
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>{title}</title>
<style>{style}
td {{ padding: 2px 14px 2px 0; }} .picture {{ background: #ffffff; }} .picture svg {{ max-width: 100%; height: auto; }}
</style>
</head>
<body>
<header class="top"><div><p class="kicker">Where the camera was</p><h1>{title}</h1></div></header>
<main>
<section class="card"><h2>In figures</h2><table>{rows}</table>{warnings}</section>
<section class="card picture">{picture}</section>
</main>
</body>
</html>
"""


def localisation_page(found: SessionLocalisation, figures: Sequence[tuple[str, str]], picture: bytes) -> str:
    """One HTML text.

    Parameters
    ----------
    figures : words and values beside them, in their order: what the truth says, where there is one.
    picture : the SVG that is shown.
    """
    svg = picture.decode("utf-8")
    rows = [*_rows(found), *figures]
    return _PAGE.format(
        title=html.escape(f"{found.session.id} in the map"),
        style=resources.files("cluster_slam.report").joinpath("assets", "style.css").read_text("utf-8"),
        rows="".join(f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>" for name, value in rows),
        warnings="".join(f"<p>{html.escape(words)}</p>" for words in found.warnings),
        picture=svg[svg.index("<svg") :],
    )


def _rows(found: SessionLocalisation) -> list[tuple[str, str]]:
    n, here = found.session.n_frames, found.is_located
    located = int(here.sum())
    lost = {words: found.reasons.count(reason) for reason, words in REASONS.items()}
    rows = [("frames", str(n)), ("located", f"{located} ({100 * located / max(n, 1):.1f} %)")]
    rows += [(f"lost: {words}", str(count)) for words, count in lost.items() if count]
    rows.append(("plants", ", ".join(sorted({p for p, is_here in zip(found.plants, here, strict=True) if is_here}))))
    if located:
        turn, shift = sureness(found)
        rows.append(("sure to (one sigma, median)", f"{shift:.2f} mm, {turn:.3f} deg"))
    return rows


def sureness(found: SessionLocalisation) -> tuple[float, float]:
    """One sigma of the located poses, median over the frames: orientation (degrees) and position (mm)."""
    var = np.nanmedian(np.diagonal(found.covs[found.is_located], axis1=1, axis2=2), axis=0)
    return float(np.degrees(np.sqrt(var[:3].sum()))), float(1e3 * np.sqrt(var[3:].sum()))
