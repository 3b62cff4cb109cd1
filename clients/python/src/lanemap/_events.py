"""What a session hears from the service."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

from ._values import Array, Pose
from .v1 import lane_map_pb2

MAX_UNREAD = 4096
"""Events kept for a slow reader of an iterator; the newest stay."""

T = TypeVar("T")


@dataclass(frozen=True)
class VehiclePose:
    """Where the vehicle is in its map."""

    sequence: int
    map_from_vehicle: Pose
    covariance: Array
    """6x6, vehicle axes: x, y, z, roll, pitch, yaw."""


@dataclass(frozen=True)
class LocalMap:
    """The map around the vehicle at one frame, and what that frame changed."""

    sequence: int
    lanes: tuple[lane_map_pb2.LocalLane, ...]
    born: tuple[int, ...]
    grown: tuple[int, ...]
    dropped: tuple[int, ...]


@dataclass(frozen=True)
class Refusal:
    """A frame that was not taken: `field` is `value`, and `limit` says what it may be."""

    sequence: int | None
    field: str
    value: str
    limit: str
    message: str


@dataclass(frozen=True)
class Gap:
    """Frames that did not come: the service goes on without them, and refuses them from here on. Frames that are numbered
    without holes, and sent in their order, are never missing."""

    first: int
    """The first number that did not come."""
    last: int
    """The last of them, inclusive."""


@dataclass
class Summary:
    """What became of a drive."""

    acked: int | None = None
    """Last durable frame, inclusive."""
    refused: int = 0
    """Frames refused, of those sent in this session."""
    reconnections: int = 0
    """Connections that broke."""


class Feed(Generic[T]):
    """An iterator over what a session hears, from when it was asked for to the session's end. Where it is not read in
    time the oldest are dropped, and counted in `missed`."""

    def __init__(self) -> None:
        self._unread: deque[T] = deque()
        self._changed = threading.Condition()
        self._end: Exception | None = None
        self._over = False
        self.missed = 0

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        with self._changed:
            self._changed.wait_for(lambda: self._unread or self._over)
            if self._unread:
                return self._unread.popleft()
            if self._end is not None:
                raise self._end
            raise StopIteration

    def put(self, event: T) -> None:
        """Something was heard."""
        with self._changed:
            if len(self._unread) == MAX_UNREAD:
                self._unread.popleft()
                self.missed += 1
            self._unread.append(event)
            self._changed.notify()

    def close(self, error: Exception | None) -> None:
        """The session is over; `error`: it failed."""
        with self._changed:
            self._over, self._end = True, error
            self._changed.notify_all()
