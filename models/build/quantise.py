"""INT8 by a table of activation ranges: the float graph with QuantizeLinear/DequantizeLinear pairs (QDQ).

Nothing here runs the network, and the arithmetic is a few element-wise float32 operations, so the
result is the same to the byte on every machine. Activations become unsigned bytes with a zero
point, weights signed bytes with one scale per output channel, biases 32-bit integers.
"""

import numpy as np
import onnx
from onnx import helper, numpy_helper

# Operations that ONNX Runtime computes on bytes when pairs stand around them.
BYTE_OPERATIONS = {"Conv", "LeakyRelu", "Concat", "Add", "Resize"}
# These move values. With one scale for the inputs and the output a concatenation is a plain copy.
ONE_SCALE = {"Concat", "Resize"}

Ranges = dict[str, tuple[float, float]]


def byte_nodes(model: onnx.ModelProto, float_nodes: set[str]) -> list[onnx.NodeProto]:
    """The nodes to quantise: all that can be, except `float_nodes`."""
    return [n for n in model.graph.node if n.op_type in BYTE_OPERATIONS and n.name not in float_nodes]


def byte_tensors(model: onnx.ModelProto, float_nodes: set[str]) -> list[str]:
    """The activations that need a range: what quantised nodes read, in the order of computation."""
    constants = {i.name for i in model.graph.initializer} | {""}
    names = [t for n in byte_nodes(model, float_nodes) for t in n.input if t not in constants]
    return list(dict.fromkeys(names))


def quantise(model: onnx.ModelProto, ranges: Ranges, float_nodes: set[str]) -> onnx.ModelProto:
    """`model` with every node but `float_nodes` computed on bytes where ONNX Runtime can."""
    missing = [t for t in byte_tensors(model, float_nodes) if t not in ranges]
    if missing:
        raise ValueError(f"no range for {', '.join(missing)}: run calibrate.py for this graph")
    return _Rewriter(model, ranges, float_nodes).result


class _Rewriter:
    """Copies the nodes in order; behind a tensor that bytes must hold it puts a pair."""

    def __init__(self, model: onnx.ModelProto, ranges: Ranges, float_nodes: set[str]):
        self.constants = {i.name: numpy_helper.to_array(i) for i in model.graph.initializer}
        self.byte_nodes = {n.name for n in byte_nodes(model, float_nodes)}
        self.parameters = self._activation_parameters(model, ranges, float_nodes)
        self.nodes: list[onnx.NodeProto] = []
        self.dequantised: dict[str, str] = {}

        for value in model.graph.input:
            self._pair_behind(value.name)
        for node in model.graph.node:
            self._copy(node)

        used = {name for node in self.nodes for name in node.input}
        self.result = onnx.ModelProto()
        self.result.CopyFrom(model)
        graph = self.result.graph
        graph.name += "-int8"
        del graph.node[:], graph.initializer[:]
        graph.node.extend(self.nodes)
        graph.initializer.extend(
            numpy_helper.from_array(values, name) for name, values in self.constants.items() if name in used
        )
        onnx.checker.check_model(self.result, full_check=True)

    def _activation_parameters(self, model, ranges: Ranges, float_nodes: set[str]) -> dict:
        """Scale and zero point by tensor; tensors tied by an operation of `ONE_SCALE` share them."""
        group = {name: [name] for name in byte_tensors(model, float_nodes)}
        for node in byte_nodes(model, float_nodes):
            if node.op_type in ONE_SCALE:
                tied = [t for t in [*node.input, *node.output] if t in group]
                joined = list(dict.fromkeys(member for t in tied for member in group[t]))
                group.update((member, joined) for member in joined)
        parameters = {}
        for name, members in group.items():
            low = np.float32(min(0.0, *(ranges[m][0] for m in members)))
            high = np.float32(max(0.0, *(ranges[m][1] for m in members)))
            scale = (high - low) / np.float32(255)
            parameters[name] = scale, np.uint8(np.rint(-low / scale))
        return parameters

    def _copy(self, node: onnx.NodeProto) -> None:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        inputs = [self.dequantised.get(name, name) for name in node.input]
        if node.name in self.byte_nodes and node.op_type == "Conv":
            activation, weights, bias = node.input
            inputs[1:] = self._weights(weights), self._bias(bias, activation, weights)
        del copy.input[:]
        copy.input.extend(inputs)
        self.nodes.append(copy)
        for name in node.output:
            self._pair_behind(name)

    def _pair_behind(self, name: str) -> None:
        if name in self.parameters:
            scale, zero = (np.array(p) for p in self.parameters[name])
            self.constants.update({f"{name}.scale": scale, f"{name}.zero": zero})
            inputs = [name, f"{name}.scale", f"{name}.zero"]
            self.nodes.append(helper.make_node("QuantizeLinear", inputs, [f"{name}.q"], name=f"{name}.quantise"))
            self.dequantised[name] = self._dequantise(name)

    def _weights(self, name: str) -> str:
        weights = self.constants[name]  # [out, in, height, width]
        largest = np.maximum(np.abs(weights).max((1, 2, 3)), np.float32(1e-8))
        scale = largest / np.float32(127)
        self.constants[f"{name}.q"] = np.rint(weights / scale[:, None, None, None]).astype(np.int8)
        self.constants[f"{name}.scale"] = scale
        self.constants[f"{name}.zero"] = np.zeros(len(scale), np.int8)
        return self._dequantise(name, axis=0)

    def _bias(self, name: str, activation: str, weights: str) -> str:
        # The accumulator counts in products of an activation's and a weight's unit.
        scale = self.parameters[activation][0] * self.constants[f"{weights}.scale"]
        self.constants[f"{name}.q"] = np.rint(self.constants[name] / scale).astype(np.int32)
        self.constants[f"{name}.scale"] = scale
        self.constants[f"{name}.zero"] = np.zeros(len(scale), np.int32)
        return self._dequantise(name, axis=0)

    def _dequantise(self, name: str, **axis: int) -> str:
        inputs = [f"{name}.q", f"{name}.scale", f"{name}.zero"]
        node = helper.make_node("DequantizeLinear", inputs, [f"{name}.dq"], name=f"{name}.dequantise", **axis)
        self.nodes.append(node)
        return f"{name}.dq"
