"""A rendered session, written picture by picture: level 1 with truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.io.folder import write_folder
from cluster_slam.io.result import stamp_words
from cluster_slam.io.session_writer import Moments, check_session_output, session_files
from cluster_slam.simulate.render.frames import Picture, Renderer
from cluster_slam.simulate.session import Simulated

Progress = Callable[[str, float], None]
_BOX_PATTERN = "{:.4f},{:.4f},{:.3f},{:.3f},{:.3f},{:.6f}"
_BOXES = "timestamp,flower_id,cluster_id,u,v,width,height,visible,depth"


def write_rendered(
    out: Path, made: Simulated, moments: Moments, *, seed: int, progress: Progress | None = None
) -> None:
    """Write a session of pictures, whole or not at all.

    ``truth/boxes.csv`` has, beside what all sessions have, each flower in each picture: its centre, its box about it,
    which share of it is seen, and its depth.

    Raises
    ------
    OutputError
        ``out`` holds something else, or cannot be written.
    """
    check_session_output(out)
    write_folder(out, _Files(made, moments, seed, progress))


class _Files(Mapping[str, str | bytes]):
    """The files of the session, rendered as they are written."""

    def __init__(self, made: Simulated, moments: Moments, seed: int, progress: Progress | None) -> None:
        from dataclasses import replace

        self._made, self._progress = made, progress
        self._renderer = Renderer(made, seed=seed)
        self._stamps = stamp_words(made.session.stamps)
        truth = replace(made.truth, flower_ids=None, cluster_ids=None)
        self._small = session_files(made.session, truth, camera=made.camera, moments=moments)
        self._small["session.toml"] = _with_depth(self._small["session.toml"], self._renderer)
        for name in ("rgb", "depth"):
            kind = "jpg" if name == "rgb" else "png"
            lines = [f"{stamp} {name}/{k:06d}.{kind}" for k, stamp in enumerate(self._stamps)]
            self._small[f"{name}.txt"] = "\n".join(["# timestamp filename", *lines, ""])
        self._boxes = [_BOXES]

    def __getitem__(self, name: str) -> str | bytes:
        return self._small[name]

    def __iter__(self) -> Iterator[str]:
        for name, _ in self._files():
            yield name

    def __len__(self) -> int:
        return len(self._small) + 2 * len(self._stamps) + 1

    def items(self) -> Iterator[tuple[str, str | bytes]]:  # type: ignore[override]
        """Names and contents; each picture is made when it is its turn."""
        return self._files()

    def _files(self) -> Iterator[tuple[str, str | bytes]]:
        yield from self._small.items()
        for k in range(len(self._stamps)):
            if self._progress is not None:
                self._progress("rendering", k / len(self._stamps))
            picture = self._renderer.frame(k)
            self._boxes += self._box_rows(k, picture)
            yield f"rgb/{k:06d}.jpg", _jpeg(picture, self._made.config.look.jpeg_quality)
            yield f"depth/{k:06d}.png", _png(picture)
        yield "truth/boxes.csv", "\n".join([*self._boxes, ""])

    def _box_rows(self, k: int, picture: Picture) -> list[str]:
        boxes, cluster = picture.boxes, self._made.plant.flower_cluster
        values = np.column_stack([boxes.centres, boxes.sizes, boxes.visible, boxes.depths]).tolist()
        return [
            f"{self._stamps[k]},{j},{cluster[j]},{_BOX_PATTERN.format(*row)}"
            for j, row in zip(boxes.flowers.tolist(), values, strict=True)
        ]


def _with_depth(toml: str | bytes, renderer: Renderer) -> str:
    text = toml if isinstance(toml, str) else toml.decode()
    model = renderer.depth_model
    lines = f'[depth]\nscale = {model.unit_m!r}\ncamera = "{model.name}"\n'
    return text.replace("[depth]\n", lines)


def _jpeg(picture: Picture, quality: int) -> bytes:
    import cv2

    return _encoded(cv2.imencode(".jpg", picture.colour, [cv2.IMWRITE_JPEG_QUALITY, quality]))


def _png(picture: Picture) -> bytes:
    import cv2

    return _encoded(cv2.imencode(".png", picture.depth, [cv2.IMWRITE_PNG_COMPRESSION, 1]))


def _encoded(answer: tuple[bool, np.ndarray]) -> bytes:
    if not answer[0]:
        raise InputError("the picture cannot be encoded")
    return answer[1].tobytes()
