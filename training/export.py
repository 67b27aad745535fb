"""The network as ONNX, with the signature and metadata of a YOLOv8 export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from network import STRIDE, Exported, FlowerNet

STRIDE_MOST = 16  # of any layer: pictures have multiples of it
METADATA = {
    "description": "flowers of brambles, trained on renderings",
    "task": "detect",
    "stride": str(STRIDE_MOST),
    "names": "{0: 'flower'}",
    "license": "MIT",
    "score": "0.6",
    "pixel_origin": "centre",
}


def write_onnx(net: FlowerNet, path: Path, more: dict[str, str] | None = None) -> None:
    """Write the network, sizes of the picture free (multiples of 16)."""
    import onnx

    path.parent.mkdir(parents=True, exist_ok=True)
    example = torch.rand(1, 3, 480, 640)
    dynamic = {"images": {2: STRIDE_MOST * torch.export.Dim("rows"), 3: STRIDE_MOST * torch.export.Dim("columns")}}
    model = Exported(net).eval()
    with torch.no_grad():
        program = torch.onnx.export(
            model,
            (example,),
            dynamo=True,
            external_data=False,
            input_names=["images"],
            output_names=["output0"],
            dynamic_shapes=dynamic,
            verbose=False,
        )
    program.save(str(path))
    made = onnx.load(str(path))
    for key, value in {**METADATA, **(more or {})}.items():
        entry = made.metadata_props.add()
        entry.key, entry.value = key, value
    made.producer_name, made.doc_string = "cluster-slam", ""
    for node in made.graph.node:
        node.doc_string = ""
        del node.metadata_props[:]
    for value in (*made.graph.input, *made.graph.output, *made.graph.value_info):
        value.doc_string = ""
        del value.metadata_props[:]
    del made.graph.value_info[:]
    del made.graph.metadata_props[:]
    onnx.save(made, str(path))
    check(model, path, example)


def check(model: Exported, path: Path, example: torch.Tensor) -> None:
    """The file gives what the network gives, at two sizes."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for images in (example, torch.rand(1, 3, 480, 848)):
        expected = model(images).detach().numpy()
        found = session.run(None, {"images": images.numpy()})[0]
        cells = images.shape[2] * images.shape[3] // STRIDE**2
        if found.shape != (1, 5, cells) or not np.allclose(found, expected, rtol=1e-3, atol=1e-3):
            raise SystemExit(f"{path}: the file does not give what the network gives")
