#!/usr/bin/env python3
"""Prints who is where: `example.py http://127.0.0.1:8080 [--token T] [--camera gate] [--messages N]`."""

import argparse
import asyncio
import os
import signal
import sys
from contextlib import aclosing

from gakp_client import Client, Refused


async def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("--token", default=os.environ.get("GAKP_TOKEN"))
    parser.add_argument("--camera", action="append", default=[])
    parser.add_argument("--messages", type=int, default=0, help="end after so many; 0: never")
    args = parser.parse_args()
    left = args.messages
    gakp = Client(args.url, args.token)
    async with aclosing(gakp.tracks(camera=args.camera, state=["confirmed"])) as messages:
        async for message in messages:
            if message.HasField("gap"):
                print(f"lost {message.gap.first}..{message.gap.last} of {message.gap.camera}", file=sys.stderr)
                continue
            frame = message.frame
            for track in frame.tracks:
                box = f"{track.x:.1f} {track.y:.1f} {track.w:.1f} {track.h:.1f}"
                print(frame.camera, frame.epoch, frame.seq, track.id, box)
            left -= 1
            if left == 0:
                break
    return 0


if __name__ == "__main__":
    # Into `head`, say.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        sys.exit(asyncio.run(main()))
    except Refused as error:
        sys.exit(f"refused: {error}")
    except KeyboardInterrupt:
        pass
