"""Tracks and events of a gakp service, as they happen.

    gakp = Client("http://127.0.0.1:8080", token="gakp_...")
    async for message in gakp.tracks(camera=["gate"], state=["confirmed"]):
        ...

Who leaves the loop before its end closes the stream with `contextlib.aclosing`, as example.py does.

Tracks are the messages of `proto/tracks.proto`, events are dictionaries (docs/api.md). A service that restarts, or a
network that breaks, is waited for; what was missed in between is not sent again, which the `epoch` and `seq` of reports
tell. A client that reads too slowly is told what it lost by a `gap`.
"""

from __future__ import annotations

import asyncio
import json
import ssl
from collections.abc import AsyncIterator, Sequence
from urllib.parse import urlencode, urlsplit

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from .tracks_pb2 import FrameTracks, Gap, Track, TrackMessage

__all__ = ["Client", "FrameTracks", "Gap", "Refused", "Track", "TrackMessage"]

_LONGEST_WAIT_S = 10.0


class Refused(Exception):
    """The service refuses: a wrong token, an unknown camera. Trying again would not help."""


class Client:
    """A service at `url` (`http://` or `https://`), asked by the bearer of `token` where it wants one.

    `tls` is for a certificate that the system does not know. With `reconnect=False` a stream ends with its connection.
    """

    def __init__(self, url: str, token: str | None = None, *, tls: ssl.SSLContext | None = None, reconnect: bool = True):
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise ValueError(f"{url!r} is no http:// or https:// address")
        self._base = f"{'wss' if parts.scheme == 'https' else 'ws'}://{parts.netloc}"
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._tls = tls
        self._reconnect = reconnect

    async def tracks(
        self,
        *,
        camera: Sequence[str] = (),
        class_: Sequence[str] = (),
        state: Sequence[str] = (),
        min_confidence: float | None = None,
        rate: float | None = None,
    ) -> AsyncIterator[TrackMessage]:
        """Reports (`frame`) and what was lost (`gap`), by the filters of `/v1/tracks`; empty means all."""
        query = [("camera", name) for name in camera]
        query += [("class", name) for name in class_]
        query += [("state", name) for name in state]
        query += [("min_confidence", str(min_confidence))] if min_confidence is not None else []
        query += [("rate", str(rate))] if rate is not None else []
        async for data in self._messages("/v1/tracks", query, "gakp.v1.protobuf"):
            message = TrackMessage()
            message.ParseFromString(data if isinstance(data, bytes) else data.encode())
            yield message

    async def events(self, *, camera: Sequence[str] = (), type: Sequence[str] = ()) -> AsyncIterator[dict]:
        """What happens at lines and in zones, by the filters of `/v1/events/live`; empty means all."""
        query = [("camera", name) for name in camera] + [("type", name) for name in type]
        async for data in self._messages("/v1/events/live", query, None):
            yield json.loads(data)

    async def _messages(
        self, path: str, query: list[tuple[str, str]], protocol: str | None
    ) -> AsyncIterator[str | bytes]:
        address = f"{self._base}{path}?{urlencode(query)}"
        wait = 0.5
        while True:
            try:
                async with connect(
                    address,
                    additional_headers=self._headers,
                    subprotocols=[protocol] if protocol else None,
                    ssl=self._tls,
                    # Reports of many tracks are large, and what they cost is the service's to bound.
                    max_size=None,
                ) as socket:
                    wait = 0.5
                    async for data in socket:
                        yield data
            except InvalidStatus as error:
                if error.response.status_code < 500:
                    raise Refused(_detail(error)) from None
            except (ConnectionClosed, OSError, TimeoutError):
                pass
            if not self._reconnect:
                return
            await asyncio.sleep(wait)
            wait = min(wait * 2, _LONGEST_WAIT_S)


def _detail(error: InvalidStatus) -> str:
    """What the service says of it."""
    try:
        return json.loads(error.response.body)["detail"]
    except (TypeError, ValueError, KeyError):
        return f"HTTP {error.response.status_code}"
