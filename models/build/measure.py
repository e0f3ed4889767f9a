"""Accuracy and speed of NanoDet models on videos with MOTChallenge ground truth.

    measure.py --sequence VIDEO GT.TXT [--sequence VIDEO GT.TXT ...] MODEL.onnx [MODEL.onnx ...]

AP50 is the area under the precision-recall curve at an overlap of 0.5 with all detections, precision
and recall are those at --threshold. Speed: the best run of many on one thread, and the frames/s of
two sessions of one thread each side by side, the best second of several. Rows of a Markdown table.
"""

import argparse
import threading
import time
from pathlib import Path

import numpy as np
import onnxruntime

from frames import letterbox, read_video

LOWEST_SCORE = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--sequence", nargs=2, action="append", type=Path, required=True, metavar=("VIDEO", "GT"))
    parser.add_argument("--size", default="352x288")
    parser.add_argument("--threshold", type=float, default=0.45)
    parser.add_argument("--nms", type=float, default=0.6)
    parser.add_argument("--seconds", type=int, default=6, help="how long to time each arrangement")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    sequences = [
        (video.stem, [letterbox(frame, width, height) for frame in read_video(video)], read_ground_truth(gt))
        for video, gt in args.sequence
    ]
    names = "".join(f" {name} AP50 (P/R) |" for name, _, _ in sequences)
    print(f"| model | MB | ms, 1 thread | frames/s, 2 sessions |{names}")
    print("| --- |" + " --- |" * (3 + len(sequences)))
    for model in args.models:
        accuracies = ""
        for _, inputs, truth in sequences:
            session = open_session(model)
            detections = [
                detect(session, image, scale, LOWEST_SCORE, args.nms) for image, scale in inputs
            ]
            ap, precision, recall = score(detections, truth, args.threshold)
            accuracies += f" {ap:.3f} ({precision:.3f}/{recall:.3f}) |"
        image = sequences[0][1][len(sequences[0][1]) // 2][0]
        single, double = best_time(model, image, args.seconds), best_rate(model, image, args.seconds)
        size = model.stat().st_size / 1e6
        print(f"| {model.stem} | {size:.1f} | {single * 1e3:.2f} | {double:.0f} |{accuracies}", flush=True)


def open_session(model: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def best_time(model: Path, image: np.ndarray, seconds: int) -> float:
    session, best, end = open_session(model), float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end:
        start = time.perf_counter()
        session.run(None, {"images": image})
        best = min(best, time.perf_counter() - start)
    return best


def best_rate(model: Path, image: np.ndarray, seconds: int) -> float:
    """Runs two sessions on two threads; ONNX Runtime releases Python's lock while it computes."""
    finished: list[float] = []
    end = time.perf_counter() + seconds

    def work() -> None:
        session = open_session(model)
        while time.perf_counter() < end:
            session.run(None, {"images": image})
            finished.append(time.perf_counter())

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    times = np.sort(finished)
    return max(np.searchsorted(times, t + 1.0) - i for i, t in enumerate(times))


def detect(session, image: np.ndarray, scale: float, threshold: float, nms: float) -> np.ndarray:
    """Rows x1, y1, x2, y2, score in pixels of the frame, the best score first."""
    output = session.run(None, {"images": image})[0][0]
    centres, strides = anchors(*image.shape[2:])
    keep = output[:, 0] >= threshold
    logits = output[keep, -44:].reshape(-1, 4, 11)
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    distances = (weights * np.arange(11)).sum(-1) / weights.sum(-1) * strides[keep, None]
    corners = np.c_[centres[keep] - distances[:, :2], centres[keep] + distances[:, 2:]] / scale
    return suppress(np.c_[corners, output[keep, 0]], nms)


def anchors(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    centres, strides = [], []
    for stride in (8, 16, 32):
        y, x = np.mgrid[0 : height // stride, 0 : width // stride]
        centres.append(np.c_[x.ravel() + 0.5, y.ravel() + 0.5] * stride)
        strides.append(np.full(x.size, stride))
    return np.concatenate(centres), np.concatenate(strides)


def suppress(boxes: np.ndarray, limit: float) -> np.ndarray:
    boxes = boxes[np.argsort(-boxes[:, 4], kind="stable")]
    overlap, kept = iou(boxes, boxes), []
    for i in range(len(boxes)):
        if not kept or overlap[i, kept].max() <= limit:
            kept.append(i)
    return boxes[kept]


def iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:4], b[None, :, 2:4])
    common = np.clip(high - low, 0, None).prod(2)
    area = lambda boxes: (boxes[:, 2:4] - boxes[:, :2]).prod(1)
    return common / np.maximum(area(a)[:, None] + area(b)[None] - common, 1e-9)


def read_ground_truth(path: Path) -> dict[int, np.ndarray]:
    """Boxes x1, y1, x2, y2 by frame, the first frame is 1; rows whose column 7 is 0 do not count."""
    truth: dict[int, list] = {}
    for row in np.loadtxt(path, delimiter=",", ndmin=2):
        if row[6] != 0:
            truth.setdefault(int(row[0]), []).append([row[2], row[3], row[2] + row[4], row[3] + row[5]])
    return {frame: np.array(boxes) for frame, boxes in truth.items()}


def score(detections: list[np.ndarray], truth: dict[int, np.ndarray], threshold: float) -> tuple[float, float, float]:
    """AP50, and precision and recall of the detections above `threshold`."""
    results = []  # (score, is it right) of every detection
    for number, boxes in enumerate(detections, start=1):
        people = truth.get(number, np.zeros((0, 4)))
        overlap, free = iou(boxes, people), np.ones(len(people), bool)
        for row, found in zip(overlap, boxes[:, 4]):
            best = int(np.argmax(np.where(free, row, -1))) if len(people) else -1
            right = best >= 0 and free[best] and row[best] >= 0.5
            if right:
                free[best] = False
            results.append((found, right))
    results.sort(key=lambda r: -r[0])
    scores, right = np.array([r[0] for r in results]), np.array([r[1] for r in results], float)
    total = sum(len(boxes) for number, boxes in truth.items() if number <= len(detections))
    hits, tried = np.cumsum(right), np.arange(1, len(right) + 1)
    recall, precision = hits / total, np.maximum.accumulate((hits / tried)[::-1])[::-1]
    ap = float(np.sum(np.diff(recall, prepend=0) * precision))
    count = int((scores >= threshold).sum())
    return ap, float(hits[count - 1] / count) if count else 0.0, float(hits[count - 1] / total) if count else 0.0


if __name__ == "__main__":
    main()
