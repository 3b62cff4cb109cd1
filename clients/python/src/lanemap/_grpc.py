"""The way to a service over gRPC."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, cast
from urllib.parse import urlsplit

import grpc
from google.protobuf import duration_pb2
from google.protobuf.message import DecodeError

from ._link import Credentials, Link, Stream
from .errors import StreamBroken
from .v1 import ingest_service_pb2

METHOD = "/lanemap.v1.IngestService/StreamObservations"
TRANSIENT = {
    grpc.StatusCode.UNAVAILABLE,
    grpc.StatusCode.UNKNOWN,
    grpc.StatusCode.CANCELLED,
    grpc.StatusCode.INTERNAL,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
    grpc.StatusCode.DEADLINE_EXCEEDED,
}


class GrpcLink(Link):
    """A channel, made anew for every stream: a connection that stalls is not waited for."""

    def __init__(self, url: str, credentials: Credentials, keep_alive_s: float) -> None:
        parts = urlsplit(url)
        self._target = f"{parts.hostname}:{parts.port or (443 if parts.scheme == 'https' else 80)}"
        if parts.hostname is not None and ":" in parts.hostname:
            self._target = f"[{parts.hostname}]:{parts.port}"
        self._credentials = credentials
        self._channel_credentials = _channel_credentials(credentials) if parts.scheme == "https" else None
        milliseconds = max(1, int(keep_alive_s * 1000))
        self._options = [
            ("grpc.keepalive_time_ms", milliseconds),
            ("grpc.keepalive_timeout_ms", milliseconds),
            ("grpc.keepalive_permit_without_calls", 1),
            # Any other ping that is not answered tells the same; its own default is a minute.
            ("grpc.http2.ping_timeout_ms", milliseconds),
            ("grpc.http2.max_pings_without_data", 0),
            ("grpc.max_receive_message_length", 64 * 1024 * 1024),
            # A connection of its own for every stream.
            ("grpc.use_local_subchannel_pool", 1),
            ("grpc.enable_retries", 0),
        ]

    def open(self, requests: Iterator[bytes]) -> Stream:
        token = self._credentials.bearer()
        metadata = () if token is None else (("authorization", f"Bearer {token}"),)
        if self._channel_credentials is None:
            channel = grpc.insecure_channel(self._target, options=self._options)
        else:
            channel = grpc.secure_channel(self._target, self._channel_credentials, options=self._options)
        method = channel.stream_stream(
            METHOD,
            request_serializer=_as_it_is,
            response_deserializer=ingest_service_pb2.StreamObservationsResponse.FromString,
        )
        # A token that is not believed may be another one by the next stream.
        renewed = {grpc.StatusCode.UNAUTHENTICATED} if self._credentials.token_file is not None else set()
        return _GrpcStream(channel, method(requests, metadata=metadata), TRANSIENT | renewed)

    def close(self) -> None:
        pass


class _Call(Protocol):
    """What gRPC gives for a stream."""

    def __next__(self) -> ingest_service_pb2.StreamObservationsResponse: ...

    def cancel(self) -> None: ...


class _GrpcStream(Stream):
    def __init__(self, channel: grpc.Channel, call: object, transient: set[grpc.StatusCode]) -> None:
        self._channel, self._call, self._transient = channel, cast(_Call, call), transient

    def answer(self) -> ingest_service_pb2.StreamObservationsResponse | None:
        try:
            return next(self._call)
        except StopIteration:
            return None
        except grpc.RpcError as error:
            raise _broken(error, self._transient) from error

    def cancel(self) -> None:
        self._call.cancel()
        self._channel.close()


def _as_it_is(request: bytes) -> bytes:
    return request


def _channel_credentials(credentials: Credentials) -> grpc.ChannelCredentials:
    def read(path: object) -> bytes | None:
        return None if path is None else Path(str(path)).read_bytes()

    return grpc.ssl_channel_credentials(read(credentials.ca), read(credentials.key), read(credentials.cert))


def _broken(error: grpc.RpcError, transient: set[grpc.StatusCode]) -> StreamBroken:
    if not isinstance(error, grpc.Call):
        return StreamBroken(str(error), transient=True)
    code, details = error.code(), error.details()
    return StreamBroken(
        f"{details} ({code.name})", transient=code in transient, retry_after_s=_retry_after_s(error)
    )


def _retry_after_s(call: grpc.Call) -> float | None:
    """`google.rpc.RetryInfo` of a status, where there is one.

    The two messages around it have two fields in all; to read them here costs less than another package.
    """
    for key, value in call.trailing_metadata() or ():
        if key == "grpc-status-details-bin" and isinstance(value, bytes):
            for detail in _fields(value).get(3, []):
                packed = _fields(detail)
                if packed.get(1, [b""])[0].endswith(b"/google.rpc.RetryInfo"):
                    for retry_delay in _fields(packed.get(2, [b""])[0]).get(1, []):
                        try:
                            delay = duration_pb2.Duration.FromString(retry_delay)
                        except DecodeError:
                            return None
                        return delay.seconds + delay.nanos * 1e-9
    return None


def _fields(message: bytes) -> dict[int, list[bytes]]:
    """The length-delimited fields of a protobuf message by their numbers."""
    fields: dict[int, list[bytes]] = {}
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while at < len(message):
            byte = message[at]
            at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
            shift += 7
        return value

    while at < len(message):
        tag = varint()
        if tag & 7 == 2:
            length = varint()
            if at + length > len(message):
                break
            fields.setdefault(tag >> 3, []).append(message[at : at + length])
            at += length
        elif tag & 7 == 0:
            varint()
        else:
            break
    return fields
