"""NanoDet-g from its TensorFlow.js graph to an ONNX graph of dynamic size.

The TF.js graph is a channels-last conversion of a PyTorch export, with a transpose around every
convolution and the shapes of a 416 x 416 input baked into its ends. Only what computes is kept:
convolutions, LeakyReLU, one max-pooling, concatenations, additions and the FPN's resizing, all in
PyTorch's channels-first layout; the end of the graph is written anew.

Input `images` [batch, 3, height, width], height and width multiples of 32.
Output `output` [batch, anchors, classes + 44]: sigmoid scores, then for left, top, right and bottom
eleven logits each, the distribution of that distance in strides. The anchors run over the strides
8, 16 and 32, row by row.
"""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from tfjs import Graph, Node

COCO_CLASSES = 80
BOX_LOGITS = 4 * 11
STRIDES = (8, 16, 32)
OPSET = 17


def convert(graph: Graph, classes: list[int]) -> onnx.ModelProto:
    """The ONNX model that scores only `classes` (columns of COCO's 80, person is 0)."""
    body = _Body(graph, head_channels=[*classes, *range(COCO_CLASSES, COCO_CLASSES + BOX_LOGITS)])
    # The graph splits the last convolution of each stride into scores and boxes. The numbers in
    # the names of the splits grow with the stride.
    splits = sorted(
        (n for n in graph.nodes.values() if n.op == "SplitV"),
        key=lambda n: int(n.name.rsplit("_", 1)[1]),
    )
    if len(splits) != len(STRIDES):
        raise ValueError(f"expected one head per stride {STRIDES}, found {len(splits)}")
    levels = [body.tensor(split.inputs[0]) for split in splits]
    body.end(levels, len(classes))

    channels = len(classes) + BOX_LOGITS
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, ["batch", 3, "height", "width"])
    output = helper.make_tensor_value_info("output", TensorProto.FLOAT, ["batch", "anchors", channels])
    model = helper.make_model(
        helper.make_graph(body.nodes, "nanodet-g", [images], [output], body.initializers),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=8,
        producer_name="gakp",
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def float_nodes(model: onnx.ModelProto) -> set[str]:
    """Nodes that stay in floating point when the model is quantised.

    The heads, because scores and boxes come straight from them, and the stem: a convolution of three
    channels is faster in float32, and its input and output are where eight bits lose most.
    """
    weights = {i.name: i.dims for i in model.graph.initializer}
    convolutions = [n for n in model.graph.node if n.op_type == "Conv"]
    stem = next(n for n in convolutions if weights[n.input[1]][1] == 3)
    flattened = {n.input[0] for n in model.graph.node if n.op_type == "Reshape"}
    heads = {n.name for n in convolutions if n.output[0] in flattened}
    tail = {n.name for n in model.graph.node if n.op_type == "Concat" and _axis(n) == 2}
    return {stem.name, "maxpool_0", "leakyrelu_0", *heads, *tail}


def _axis(node: onnx.NodeProto) -> int:
    return next(a.i for a in node.attribute if a.name == "axis")


class _Body:
    """Walks back from the heads to the input and writes ONNX nodes in the order of computation."""

    def __init__(self, graph: Graph, head_channels: list[int]):
        self.graph = graph
        self.head_channels = head_channels
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []
        self.written: dict[str, str] = {}
        self.counts: dict[str, int] = {}

    def tensor(self, name: str) -> str:
        """The ONNX tensor that holds what TF.js node `name` computes."""
        if name not in self.written:
            self.written[name] = self._write(self.graph.nodes[name])
        return self.written[name]

    def _write(self, node: Node) -> str:
        match node.op:
            case "Placeholder":
                return "images"
            # Between channels first and last: the ONNX graph stays channels first.
            case "Transpose":
                return self.tensor(node.inputs[0])
            case "Add" if self._source(node.inputs[0]).op == "Conv2D":
                return self._convolution(self._source(node.inputs[0]), bias=node.inputs[1])
            case "Add":
                return self.emit("Add", [self.tensor(i) for i in node.inputs])
            case "LeakyRelu":
                return self.emit("LeakyRelu", [self.tensor(node.inputs[0])], alpha=node.number("alpha"))
            case "MaxPool":
                return self._max_pool(node)
            case "ConcatV2":
                return self.emit("Concat", [self.tensor(i) for i in node.inputs[:-1]], axis=1)
            case "ResizeBilinear":
                return self._resize(node)
        raise ValueError(f"no conversion for operation {node.op} ({node.name})")

    def _source(self, name: str) -> Node:
        """The node behind `name`, looking through changes of layout."""
        node = self.graph.nodes[name]
        return self._source(node.inputs[0]) if node.op == "Transpose" else node

    def _padded(self, name: str) -> tuple[str, int]:
        """Where `name` comes from, and by how many pixels it was padded on every side."""
        node = self._source(name)
        if node.op not in ("Pad", "PadV2"):
            return name, 0
        amounts = sorted(self.graph.constants[node.inputs[1]].ravel().tolist())
        # Two of the four axes are spatial, each padded at its start and its end.
        if amounts[:4] != [0] * 4 or len(set(amounts[4:])) != 1:
            raise ValueError(f"{node.name} pads unevenly: {amounts}")
        return node.inputs[0], amounts[-1]

    def _convolution(self, node: Node, bias: str) -> str:
        weights = self.graph.constants[node.inputs[1]].transpose(3, 2, 0, 1)  # HWIO -> OIHW
        biases = self.graph.constants[bias].ravel()
        source, padding = self._padded(node.inputs[0])
        if node.text("padding") != "VALID" and weights.shape[2:] != (1, 1):
            raise ValueError(f"{node.name} pads implicitly")
        if len(weights) == COCO_CLASSES + BOX_LOGITS:
            weights, biases = weights[self.head_channels], biases[self.head_channels]
        inputs = [self.tensor(source)]
        number = self.counts.get("Conv", 0)
        inputs += [
            self.constant(f"conv_{number}.weight", weights),
            self.constant(f"conv_{number}.bias", biases),
        ]
        return self.emit(
            "Conv",
            inputs,
            kernel_shape=list(weights.shape[2:]),
            strides=node.integers("strides")[1:3],
            pads=[padding] * 4,
        )

    def _max_pool(self, node: Node) -> str:
        """Max-pooling of an activation, written as the activation of a max-pooling.

        LeakyReLU grows with its argument, so both orders give the same values; this one computes
        it for a quarter of the pixels.
        """
        source, padding = self._padded(node.inputs[0])
        activation = self._source(source)
        if activation.op != "LeakyRelu":
            raise ValueError(f"{node.name} pools {activation.op}, expected LeakyRelu")
        pooled = self.emit(
            "MaxPool", [self.tensor(activation.inputs[0])], kernel_shape=[3, 3], strides=[2, 2], pads=[padding] * 4
        )
        return self.emit("LeakyRelu", [pooled], alpha=activation.number("alpha"))

    def _resize(self, node: Node) -> str:
        """FPN: the top-down path doubles the size, the bottom-up path halves it."""
        if not node.flag("half_pixel_centers"):
            raise ValueError(f"{node.name}: expected half-pixel centres")
        doubles = node.name.split("/")[1] in ("resize", "resize_1")
        factor = 2.0 if doubles else 0.5
        scales = self.constant(f"scales_{'up' if doubles else 'down'}", np.array([1, 1, factor, factor], np.float32))
        return self.emit(
            "Resize",
            [self.tensor(node.inputs[0]), "", scales],
            mode="linear",
            coordinate_transformation_mode="half_pixel",
        )

    def end(self, levels: list[str], classes: int) -> None:
        """Joins the strides into rows of anchors and turns the first `classes` columns into scores."""
        shape = self.constant("flat", np.array([0, classes + BOX_LOGITS, -1], np.int64))
        flat = [self.emit("Reshape", [level, shape]) for level in levels]
        rows = self.emit("Transpose", [self.emit("Concat", flat, axis=2)], perm=[0, 2, 1])
        sizes = self.constant("columns", np.array([classes, BOX_LOGITS], np.int64))
        self.nodes.append(helper.make_node("Split", [rows, sizes], ["logits", "boxes"], name="split", axis=2))
        self.nodes.append(helper.make_node("Sigmoid", ["logits"], ["scores"], name="scores"))
        self.nodes.append(helper.make_node("Concat", ["scores", "boxes"], ["output"], name="output", axis=2))

    def emit(self, op: str, inputs: list[str], **attributes) -> str:
        number = self.counts.get(op, 0)
        self.counts[op] = number + 1
        name = f"{op.lower()}_{number}"
        self.nodes.append(helper.make_node(op, inputs, [name], name=name, **attributes))
        return name

    def constant(self, name: str, values: np.ndarray) -> str:
        if name not in (i.name for i in self.initializers):
            self.initializers.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name
