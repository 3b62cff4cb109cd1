"""What can go wrong for a session. Input that is not valid is a `ValueError`, raised before anything is sent."""

from __future__ import annotations


class LanemapError(Exception):
    """Any failure below."""


class SpoolError(LanemapError):
    """The spool's disk failed, or another process uses the drive."""


class SpoolFull(SpoolError):
    """There is no room for a frame now; the frame was not taken, and the session goes on."""


class SessionError(LanemapError):
    """The session failed for good. What is in the spool stays there."""


class Refused(SessionError):
    """The service refused the start of the session: `field` is `value`, and `limit` says what it may be."""

    def __init__(self, field: str, value: str, limit: str, message: str) -> None:
        super().__init__(message)
        self.field, self.value, self.limit = field, value, limit


class StreamBroken(LanemapError):
    """A stream ended; the session tries another where `transient`, no sooner than after `retry_after_s`."""

    def __init__(self, reason: str, *, transient: bool, retry_after_s: float | None = None) -> None:
        super().__init__(reason)
        self.transient, self.retry_after_s = transient, retry_after_s
