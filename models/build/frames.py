"""Video frames as the network's input: decoded by the ffmpeg command, resized and normalised by NumPy."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np

# BGR, on 0..255.
MEAN = np.array([103.53, 116.28, 123.675], np.float32)
STD = np.array([57.375, 57.12, 58.395], np.float32)


def read_video(path: Path) -> Iterator[np.ndarray]:
    """Every frame as BGR bytes [height, width, 3]."""
    probe = ["ffprobe", "-v", "error", "-select_streams", "v:0", "-show_entries", "stream=width,height"]
    stream = json.loads(subprocess.check_output([*probe, "-of", "json", str(path)]))["streams"][0]
    width, height = stream["width"], stream["height"]
    decode = ["ffmpeg", "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "bgr24", "-"]
    with subprocess.Popen(decode, stdout=subprocess.PIPE) as process:
        while frame := process.stdout.read(width * height * 3):
            yield np.frombuffer(frame, np.uint8).reshape(height, width, 3)


def letterbox(frame: np.ndarray, width: int, height: int) -> tuple[np.ndarray, float]:
    """The network's input [1, 3, height, width] and the scale from frame to input pixels.

    The frame lies in the top left corner; the rest is black (zero before normalisation).
    """
    scale = min(width / frame.shape[1], height / frame.shape[0])
    canvas = np.zeros((height, width, 3), np.float32)
    small = resize(frame, round(frame.shape[1] * scale), round(frame.shape[0] * scale))
    canvas[: small.shape[0], : small.shape[1]] = small
    return np.ascontiguousarray(((canvas - MEAN) / STD).transpose(2, 0, 1)[None]), scale


def resize(frame: np.ndarray, width: int, height: int) -> np.ndarray:
    """Bilinear, half-pixel centres, rounded to whole grey values."""

    def weights(size_in: int, size_out: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        position = np.clip((np.arange(size_out) + 0.5) * size_in / size_out - 0.5, 0, size_in - 1)
        low = np.floor(position).astype(int)
        return low, np.minimum(low + 1, size_in - 1), (position - low).astype(np.float32)

    top, bottom, down = weights(frame.shape[0], height)
    left, right, across = weights(frame.shape[1], width)
    rows = frame[top] * (1 - down)[:, None, None] + frame[bottom] * down[:, None, None]
    both = rows[:, left] * (1 - across)[None, :, None] + rows[:, right] * across[None, :, None]
    return np.rint(both).astype(np.float32)
