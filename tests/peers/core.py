#!/usr/bin/env python3
"""Other people's trackers on MOTChallenge detections: one thread, update() alone timed. Default settings, but for
pyxtrackers' ByteTrack, which has the thresholds of its paper's code (0.6, 0.9) instead of the package's (0.5, 0.8).

  core.py ROOT DET [--second-half]

Prints `NAME X us/frame` for SORT and ByteTrack of pyxtrackers and trackforge, over all sequences
ROOT/*-DET; `gakp bench core --peer "python core.py"` calls it and prints the figures beside its own.

  python3 -m venv .venv && .venv/bin/pip install numpy pyxtrackers==2026.3.3 trackforge==0.4.0
"""
import argparse
import configparser
import glob
import os
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
import pyxtrackers
import trackforge


def load(folder, second_half):
    """Frames of rows x1, y1, x2, y2, score."""
    ini = configparser.ConfigParser()
    ini.read(os.path.join(folder, "seqinfo.ini"))
    length = int(ini["Sequence"]["seqLength"])
    first = length // 2 + 2 if second_half else 1
    rows = np.loadtxt(os.path.join(folder, "det/det.txt"), delimiter=",", ndmin=2)
    corners = np.c_[rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6], rows[:, 6]]
    return [np.ascontiguousarray(corners[rows[:, 0] == frame]) for frame in range(first, length + 1)]


def boxes(frame):
    """What trackforge takes: ([x, y, w, h], score, class)."""
    return [([float(v) for v in (r[0], r[1], r[2] - r[0], r[3] - r[1])], float(r[4]), 0) for r in frame]


BYTETRACK = {"track_thresh": 0.6, "match_thresh": 0.9, "track_buffer": 30}
TRACKERS = {
    "pyxtrackers SORT": (lambda: pyxtrackers.Sort(), None),
    "pyxtrackers ByteTrack": (lambda: pyxtrackers.BYTETracker(**BYTETRACK), None),
    "trackforge SORT": (lambda: trackforge.SORT(), boxes),
    "trackforge ByteTrack": (lambda: trackforge.BYTETRACK(), boxes),
}
# YOLOX's detections go down to a score of 0.1. SORT has no stage for low scores: it is given the others.
LOW_SCORED, SORTS = "YOLOX", {"pyxtrackers SORT", "trackforge SORT"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root")
    parser.add_argument("det")
    parser.add_argument("--second-half", action="store_true")
    args = parser.parse_args()
    folders = sorted(glob.glob(os.path.join(args.root, f"*-{args.det}")))
    if not folders:
        parser.error(f"no sequence {args.root}/*-{args.det}")
    sequences = [load(folder, args.second_half) for folder in folders]
    for name, (make, prepare) in TRACKERS.items():
        seconds, count = 0.0, 0
        for frames in sequences:
            if args.det == LOW_SCORED and name in SORTS:
                frames = [frame[frame[:, 4] >= 0.6] for frame in frames]
            if prepare:
                frames = [prepare(frame) for frame in frames]
            update = make().update
            for frame in frames:
                start = time.perf_counter()
                update(frame)
                seconds += time.perf_counter() - start
            count += len(frames)
        print(f"{name} {seconds / count * 1e6:.2f} us/frame", flush=True)


if __name__ == "__main__":
    main()
