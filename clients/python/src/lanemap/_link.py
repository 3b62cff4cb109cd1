"""The way to a service: gRPC or zenoh, by the address. Both carry the same messages."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from .v1 import ingest_service_pb2


@dataclass(frozen=True)
class Credentials:
    """Who the client is and whom it trusts: paths of PEM files; a bearer token, or a file that holds it, read for every
    stream; and for zenoh a user name with a file that holds its password, read likewise."""

    ca: str | os.PathLike[str] | None = None
    cert: str | os.PathLike[str] | None = None
    key: str | os.PathLike[str] | None = None
    token: str | None = None
    token_file: str | os.PathLike[str] | None = None
    user: str | None = None
    password_file: str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        if (self.cert is None) != (self.key is None):
            raise ValueError("cert and key: one is missing, limit: both or neither")
        if self.token is not None and self.token_file is not None:
            raise ValueError("token and token_file are both given, limit: at most one")
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user and password_file: one is missing, limit: both or neither")

    def bearer(self) -> str | None:
        """The token as it is now."""
        return Path(self.token_file).read_text().strip() if self.token_file is not None else self.token

    def __repr__(self) -> str:
        return f"Credentials(ca={self.ca!r}, cert={self.cert!r})"


class Stream(ABC):
    """One open stream."""

    @abstractmethod
    def answer(self) -> ingest_service_pb2.StreamObservationsResponse | None:
        """The next answer; `None` where the service has ended the stream well. Raises `StreamBroken`."""

    @abstractmethod
    def cancel(self) -> None:
        """Gives the stream up; whoever waits for an answer is told. Does no harm to one that is over."""


class Link(ABC):
    """The way to one service."""

    @abstractmethod
    def open(self, requests: Iterator[bytes]) -> Stream:
        """Opens a stream that sends what `requests` yields, from a thread of its own: `StreamObservationsRequest`s, a
        start first. Raises `StreamBroken`."""

    @abstractmethod
    def close(self) -> None:
        """Lets go of the network."""


def link_to(url: str, start: ingest_service_pb2.SessionStart, credentials: Credentials, keep_alive_s: float) -> Link:
    """The way to an address: http(s)://HOST:PORT for gRPC; tcp/HOST:PORT or tls/HOST:PORT for zenoh."""
    if url.startswith(("http://", "https://")):
        from ._grpc import GrpcLink

        return GrpcLink(url, credentials, keep_alive_s)
    if url.startswith(("tcp/", "tls/")):
        from ._zenoh import ZenohLink

        return ZenohLink(url, start, credentials, keep_alive_s)
    raise ValueError(f"url is {url!r}, limit: http://, https:// (gRPC), tcp/ or tls/ (zenoh), then HOST:PORT")
