"""What a session has taken and the service has not acked: in memory, or in a spool on disk.

The session's owner pushes, the session's threads send and forget. A stream is known by its number: a thread that still
belongs to a broken one is told so and goes.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from enum import Enum, auto

from ._spool import Spool, SpoolRecovery
from .errors import SessionError, SpoolError, SpoolFull
from .v1 import observation_pb2


class Leaving(Enum):
    """How the owner leaves the session."""

    END = auto()
    """The drive is over."""
    CLOSE = auto()
    """It stays open, to be resumed."""


class Backlog:
    """Frames that are not acked, in the order of sending."""

    def __init__(self, spool: Spool | None, max_frames: int) -> None:
        self._spool = spool
        self._frames: deque[tuple[int, bytes]] = deque()
        self._max_frames = max(1, max_frames)
        self._changed = threading.Condition()
        self._sent = 0
        self._stream = 0
        self._window: int | None = None
        self._failure: Exception | None = None
        self._over = False
        self.leaving: Leaving | None = Leaving.END if spool is not None and spool.ended else None
        if spool is not None and spool.options.sync_s:
            self._unsynced = threading.Event()
            threading.Thread(target=self._keep_synced, args=(spool.options.sync_s,), daemon=True).start()

    def __len__(self) -> int:
        return len(self._frames) if self._spool is None else len(self._spool)

    @property
    def recovery(self) -> SpoolRecovery | None:
        """What was found on disk at the beginning."""
        return None if self._spool is None else self._spool.recovery

    @property
    def last_sequence(self) -> int | None:
        """Highest sequence ever spooled."""
        return None if self._spool is None else self._spool.last_sequence

    def push(self, message: observation_pb2.Frame, timeout_s: float | None) -> None:
        """Takes a frame; waits for room, or raises `SpoolFull`, as the settings say. `TimeoutError`: not taken."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        with self._changed:
            while not self._push(message):
                left = None if until is None else until - time.monotonic()
                if left is not None and left <= 0:
                    raise TimeoutError(f"no room for frame {message.sequence} within {timeout_s} s")
                self._changed.wait(left)
            self._changed.notify_all()
            unsynced = self._to_sync()
        if unsynced is not None:
            _sync(unsynced)

    def _push(self, message: observation_pb2.Frame) -> bool:
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        if self._over or self.leaving is not None:
            raise SessionError("the session has ended")
        if self._spool is None:
            if len(self._frames) >= self._max_frames:
                return False
            self._frames.append((message.sequence, message.SerializeToString()))
            return True
        try:
            self._spool.append(message)
            return True
        except SpoolFull:
            if self._spool.options.when_full == "refuse":
                raise
            return False

    def leave(self, leaving: Leaving) -> None:
        """The owner leaves: nothing is pushed any more."""
        unsynced = None
        with self._changed:
            if self._over:
                return
            if self._spool is not None and leaving is Leaving.END:
                self._spool.append_end()
                if self._spool.options.sync_s is not None:
                    unsynced = self._spool.unsynced()
            self.leaving = leaving
            self._changed.notify_all()
        if unsynced is not None:
            _sync(unsynced)

    def begin_stream(self) -> int:
        """A new stream: its number. Nothing is sent on it before it is opened."""
        with self._changed:
            self._stream += 1
            self._sent, self._window = 0, None
            self._changed.notify_all()
            return self._stream

    def open_stream(self, window: int, resume_after: int | None) -> None:
        """The stream may send so many frames that are not acked, from the one after `resume_after` on."""
        with self._changed:
            if resume_after is not None:
                self._acked(resume_after)
            self._window = max(1, window)
            self._changed.notify_all()

    def next(self, stream: int) -> bytes | Leaving | None:
        """What the stream is to send next, once there is something; `None` where the stream is over."""
        with self._changed:
            while self._stream == stream and not self._over:
                if self._window is not None:
                    if self._sent == len(self):
                        if self.leaving is not None:
                            return self.leaving
                    elif self._sent < self._window:
                        frame = self._frames[self._sent][1] if self._spool is None else self._spool.read(self._sent)
                        self._sent += 1
                        return frame
                self._changed.wait()
            return None

    def acked(self, sequence: int) -> None:
        """Forgets what is durable."""
        with self._changed:
            self._acked(sequence)
            self._changed.notify_all()

    def _acked(self, sequence: int) -> None:
        if self._spool is not None:
            forgotten = self._spool.forget_up_to(sequence)
        else:
            forgotten = 0
            while self._frames and self._frames[0][0] <= sequence:
                self._frames.popleft()
                forgotten += 1
        self._sent = max(0, self._sent - forgotten)

    def refused(self, sequence: int) -> None:
        """Forgets a frame that was refused: the oldest of its number that was sent."""
        with self._changed:
            if self._spool is not None:
                found = self._spool.forget(sequence, self._sent)
            else:
                sent = [number for number, _ in list(self._frames)[: self._sent]]
                if found := sequence in sent:
                    del self._frames[sent.index(sequence)]
            self._sent -= int(found)
            self._changed.notify_all()

    def first_sequence(self) -> int | None:
        """Number of the oldest frame that is not acked."""
        with self._changed:
            if not len(self):
                return None
            return self._frames[0][0] if self._spool is None else self._spool.sequence(0)

    def close(self, *, delivered: bool) -> None:
        """The session is over; `delivered`: the drive has ended and the service has all of it."""
        with self._changed:
            self._over = True
            if self._spool is not None:
                self._spool.close(delivered=delivered)
            self._changed.notify_all()
        if self._spool is not None and self._spool.options.sync_s:
            self._unsynced.set()

    def _to_sync(self) -> int | None:
        if self._spool is None or self._spool.options.sync_s is None:
            return None
        if self._spool.options.sync_s == 0:
            return self._spool.unsynced()
        self._unsynced.set()
        return None

    def _keep_synced(self, within_s: float) -> None:
        assert self._spool is not None
        while True:
            self._unsynced.wait()
            time.sleep(within_s)
            with self._changed:
                if self._over:
                    return
                self._unsynced.clear()
                unsynced = self._spool.unsynced()
            try:
                _sync(unsynced)
            except SpoolError as error:
                with self._changed:
                    self._failure = error  # The next push says so.


def _sync(descriptor: int) -> None:
    """Forces a file to disk while others go on appending to it."""
    try:
        os.fdatasync(descriptor)
    except OSError as error:
        raise SpoolError(f"the spool cannot be forced to disk: {error}") from error
    finally:
        os.close(descriptor)
