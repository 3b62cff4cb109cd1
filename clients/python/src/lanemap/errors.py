"""What can go wrong for a session, or for a reader of the map. Input that is not valid is a `ValueError`, raised before anything is sent."""

from __future__ import annotations

import json


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


class MapError(LanemapError):
    """The service refused to give what was asked for: `status` of HTTP, 0 without one; its `title` and `detail`."""

    def __init__(self, detail: str, *, status: int = 0, title: str = "", retry_after_s: float | None = None) -> None:
        super().__init__(detail)
        self.status, self.title, self.detail, self.retry_after_s = status, title, detail, retry_after_s

    @classmethod
    def of(cls, address: str, status: int, body: bytes, retry_after: str | None) -> MapError:
        """The problem document (RFC 9457) of an answer, or what there is in its place."""
        try:
            problem = json.loads(body)
        except ValueError:
            problem = None
        known = problem if isinstance(problem, dict) else {}
        title, detail = str(known.get("title", "")), str(known.get("detail", "no reason is given"))
        try:
            wait_s = None if retry_after is None else float(retry_after)
        except ValueError:
            wait_s = None
        return cls(f"{address}: {status} {title}: {detail}", status=status, title=title, retry_after_s=wait_s)


class MapUnreachable(MapError):
    """The service does not answer."""
