"""Reads a TensorFlow.js graph model: the JSON graph, and the weights in the binary shards beside it."""

import base64
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Node:
    """One operation of the graph. Inputs are node names, `name:k` for output k of a node."""

    name: str
    op: str
    inputs: list[str]
    attributes: dict

    def number(self, key: str) -> float:
        """A scalar float attribute."""
        return float(self.attributes[key]["f"])

    def text(self, key: str) -> str:
        """A string attribute; the format stores strings in base64."""
        return base64.b64decode(self.attributes[key]["s"]).decode()

    def flag(self, key: str) -> bool:
        """A boolean attribute, false when absent."""
        return bool(self.attributes.get(key, {}).get("b", False))

    def integers(self, key: str) -> list[int]:
        """A list-of-integers attribute."""
        return [int(i) for i in self.attributes[key]["list"]["i"]]


@dataclass(frozen=True)
class Graph:
    """All nodes by name, and the constants by name as arrays (float16 weights widened to float32)."""

    nodes: dict[str, Node]
    constants: dict[str, np.ndarray]


def read_graph(model_json: Path) -> Graph:
    """Reads `model_json` and its weight shards."""
    document = json.loads(model_json.read_text())
    nodes = {
        n["name"]: Node(n["name"], n["op"], n.get("input", []), n.get("attr", {}))
        for n in document["modelTopology"]["node"]
    }
    constants = {}
    for group in document["weightsManifest"]:
        data = b"".join((model_json.parent / path).read_bytes() for path in group["paths"])
        constants.update(_split_weights(group["weights"], data, model_json))
    return Graph(nodes, constants)


def _split_weights(entries: list[dict], data: bytes, source: Path) -> dict[str, np.ndarray]:
    """The shards of a group are one run of bytes; entries lie in it one after another."""
    arrays, offset = {}, 0
    for entry in entries:
        stored = np.dtype(entry.get("quantization", entry)["dtype"])
        count = int(np.prod(entry["shape"], dtype=np.int64))
        array = np.frombuffer(data, stored, count, offset).reshape(entry["shape"])
        arrays[entry["name"]] = array.astype(entry["dtype"])
        offset += array.nbytes
    if offset != len(data):
        raise ValueError(f"{source}: the weights hold {len(data)} bytes, the manifest lists {offset}")
    return arrays
