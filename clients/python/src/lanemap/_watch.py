"""What changes in the map, as it changes: server-sent events, gone on with wherever a connection breaks."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, TypeAlias

import urllib3
from urllib3.response import BaseHTTPResponse

from ._http import BUSY, Http
from ._map_events import MapEvent, event_of
from .errors import MapError, MapUnreachable

# Longest pause between two attempts to go on, seconds.
MOST_PAUSE_S = 60.0
# Bytes of one event that are taken; the service's own bound is 2 MiB.
MOST_EVENT_BYTES = 16 * 1024 * 1024


@dataclass(frozen=True)
class Change:
    """A cell changed. Where `from_version` is not the version that one has, one takes the cell anew."""

    revision: int
    """The revision that the newest version gave the map."""
    cell: str
    from_version: int
    to_version: int
    lines_upserted: int
    """Lines that were new or differed, in all versions in between together."""
    lines_removed: int
    upserted: list[dict[str, Any]] | None = field(default=None, repr=False)
    """The lines as GeoJSON features, where they were asked for and are not too large."""
    removed: list[str] | None = field(default=None, repr=False)
    """Ids of the features that are no longer there, likewise."""


@dataclass(frozen=True)
class Reset:
    """What changed is not known, since too much time went by: one takes the map anew, and goes on from `revision`."""

    revision: int


News: TypeAlias = Change | MapEvent | Reset


@dataclass(frozen=True)
class _Event:
    name: str
    data: str


class Watch:
    """An iterator over changes, events and resets that does not end by itself; a `with` closes it. One thread iterates; any may close it.

    `position` is where it goes on after what it gave last: `watch(since=position)`, in another process, too.
    """

    def __init__(self, http: Http, parameters: dict[str, Any], position: str | None, silence_s: float) -> None:
        self._http, self._parameters, self._silence_s = http, parameters, silence_s
        self.position = position
        self._pause_s, self._failures = 3.0, 0
        self._response: BaseHTTPResponse | None = None
        self._closed = False
        self._events = self._told()

    def __iter__(self) -> Iterator[News]:
        return self

    def __next__(self) -> News:
        return next(self._events)

    def __enter__(self) -> Watch:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends it; who waits for a change is told that there is none."""
        self._closed = True
        response = self._response
        if response is not None:
            _shut(response)

    def _told(self) -> Iterator[News]:
        while not self._closed:
            try:
                response = self._open()
            except MapError as error:
                if not isinstance(error, MapUnreachable) and error.status not in BUSY:
                    raise
                self._rest(error.retry_after_s)
                continue
            try:
                yield from self._read(response)
            except (urllib3.exceptions.HTTPError, OSError, ValueError):
                # The connection broke, or was silent for too long: it is gone on with where it was.
                pass
            finally:
                self._response = None
                response.close()
            self._rest(None)

    def _open(self) -> BaseHTTPResponse:
        headers = {"Accept": "text/event-stream", "Accept-Encoding": "identity"}
        since = None
        if self.position is not None and (self._failures or "-" in self.position):
            headers["Last-Event-ID"] = self.position
        else:
            since = self.position
        address = self._http.address("/changes", since=since, **self._parameters)
        response = self._http.open(address, headers, preload=False, timeout_s=self._silence_s, retry=False)
        self._response = response
        return response

    def _read(self, response: BaseHTTPResponse) -> Iterator[News]:
        for event in _events(response, self._moved, self._told_pause):
            self._failures = 0
            if event.name not in _NEWS:
                continue
            yield _NEWS[event.name](json.loads(event.data))

    def _moved(self, position: str) -> None:
        self.position = position

    def _told_pause(self, milliseconds: int) -> None:
        self._pause_s = milliseconds / 1000

    def _rest(self, retry_after_s: float | None) -> None:
        """Waits before the next attempt: as long as the service said, else longer each time; never all at once."""
        self._failures += 1
        pause_s = self._pause_s * 1.5 ** min(self._failures - 1, 10) if retry_after_s is None else retry_after_s
        until = time.monotonic() + min(pause_s, MOST_PAUSE_S) * random.uniform(0.75, 1.25)
        while not self._closed and (left_s := until - time.monotonic()) > 0:
            time.sleep(min(left_s, 0.2))


def _change(data: dict[str, Any]) -> Change:
    return Change(
        revision=data["revision"],
        cell=data["cell"],
        from_version=data["from_version"],
        to_version=data["to_version"],
        lines_upserted=data["lines_upserted"],
        lines_removed=data["lines_removed"],
        upserted=data.get("upserted"),
        removed=data.get("removed"),
    )


# What is told, by the names of events; those that a newer service may send are passed over.
_NEWS: dict[str, Callable[[dict[str, Any]], News]] = {
    "cell": _change,
    "change": event_of,
    "reset": lambda data: Reset(data["revision"]),
}


def _events(
    response: BaseHTTPResponse, moved: Callable[[str], None], paused: Callable[[int], None]
) -> Iterator[_Event]:
    """Events of a stream (WHATWG HTML, 9.2.6). An id counts once its event has been taken."""
    name, data, position = "", [], None
    for line in _lines(response):
        if line:
            label, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if label == "event":
                name = value
            elif label == "data":
                data.append(value)
            elif label == "id":
                position = value
            elif label == "retry" and value.isdigit():
                paused(int(value))
            continue
        if data:
            yield _Event(name, "\n".join(data))
        if position is not None:
            moved(position)
        name, data, position = "", [], None


def _lines(response: BaseHTTPResponse) -> Iterator[str]:
    unread = b""
    while True:
        chunk = response.read1(65_536)
        if not chunk:
            return
        *lines, unread = (unread + chunk).split(b"\n")
        if len(unread) > MOST_EVENT_BYTES:
            raise ValueError("an event is too large")
        for line in lines:
            yield line.removesuffix(b"\r").decode("utf-8", "replace")


def _shut(response: BaseHTTPResponse) -> None:
    """Has whoever reads see the end."""
    response.shutdown()
