"""Measures the activation ranges that quantise.py needs, on the demo footage.

    calibrate.py FLOAT.onnx vtest.avi nanodet-g.ranges.json

Run by hand when the detector changes, never by the set-up: the last bits of a float network differ
between processors, and the quantised model must not. Its result is committed.

24 frames spread over the film, each whole and as a random half and third of its width and height: in
the crops people are large, which widens the ranges to what other cameras show. The range of a tensor
is the union over the images, without each image's outermost 0.001 percent of values at either end.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

from frames import letterbox, read_video
from nanodet import float_nodes
from quantise import byte_tensors

FRAMES = 24
CROPS = (1, 2, 3)
OUTLIERS_PERCENT = 0.001
SIZE = (352, 288)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("video", type=Path)
    parser.add_argument("table", type=Path)
    args = parser.parse_args()
    ranges = measure(onnx.load(args.model), images(args.video))
    lines = [f'  "{name}": [{low:.4g}, {high:.4g}]' for name, (low, high) in ranges.items()]
    args.table.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    json.loads(args.table.read_text())
    print(f"{args.table}: {len(ranges)} ranges")


def images(video: Path) -> list[np.ndarray]:
    frames = list(read_video(video))
    rng, result = np.random.default_rng(0), []
    for frame in frames[:: len(frames) // FRAMES][:FRAMES]:
        for parts in CROPS:
            height, width = frame.shape[0] // parts, frame.shape[1] // parts
            y, x = rng.integers(0, frame.shape[0] - height + 1), rng.integers(0, frame.shape[1] - width + 1)
            result.append(letterbox(frame[y : y + height, x : x + width], *SIZE)[0])
    return result


def measure(model: onnx.ModelProto, images: list[np.ndarray]) -> dict[str, tuple[float, float]]:
    names = byte_tensors(model, float_nodes(model))
    model.graph.output.extend(onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, None) for n in names)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    ranges = {name: (0.0, 0.0) for name in names}
    for image in images:
        for name, values in zip(names, session.run(names, {"images": image})):
            low, high = np.percentile(values, [OUTLIERS_PERCENT, 100 - OUTLIERS_PERCENT])
            ranges[name] = min(ranges[name][0], float(low)), max(ranges[name][1], float(high))
    return ranges


if __name__ == "__main__":
    main()
