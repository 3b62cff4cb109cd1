"""The way to a service over zenoh; proto/src/zenoh_keys.rs says what lies under which key.

Every stream has a zenoh session of its own, so that nothing of a stream that broke is left in the way of the next.
"""

from __future__ import annotations

import json
import os
import queue
import secrets
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import zenoh
from zenoh import ext

from ._link import Credentials, Link, Stream
from .errors import StreamBroken
from .v1 import ingest_service_pb2 as ingest

SERVER = "lanemap/v1/@server"
ENCODING = zenoh.Encoding("application/protobuf;lanemap.v1.StreamObservationsRequest")
ACCEPTED_WITHIN_S = 5.0
"""A start that is not answered so long is sent again, by a new stream: the service may have missed it."""
MAX_UPDATES = 1024
"""Poses and local maps that may wait to be read; the newest are dropped."""
# The codes of google.rpc.Code after which another try may succeed: cancelled, unknown, deadline exceeded, resource
# exhausted, failed precondition (the stream's token came late), internal, unavailable, data loss (a message did not
# arrive).
TRANSIENT = {1, 2, 4, 8, 9, 13, 14, 15}
UNAUTHENTICATED = 16


class ZenohLink(Link):
    """The way to a router, or to a server that is one."""

    def __init__(
        self, endpoint: str, start: ingest.SessionStart, credentials: Credentials, keep_alive_s: float
    ) -> None:
        self._endpoint, self._credentials, self._keep_alive_s = endpoint, credentials, keep_alive_s
        fleet, vehicle = (quote(name, safe="") for name in (start.fleet_id, start.vehicle_id))
        self._vehicle = f"lanemap/v1/{fleet}/{vehicle}"
        self._config()  # What is wrong with it is said now.

    def open(self, requests: Iterator[bytes]) -> Stream:
        token, renewed = self._credentials.bearer(), self._credentials.token_file is not None
        try:
            return _ZenohStream(zenoh.open(self._config()), self._vehicle, requests, token, renewed)
        except zenoh.ZError as error:
            raise StreamBroken(f"{self._endpoint}: {error}", transient=True) from error

    def close(self) -> None:
        pass

    def _config(self) -> zenoh.Config:
        settings: dict[str, object] = {
            "mode": "client",
            "connect/endpoints": [self._endpoint],
            "connect/timeout_ms": 10_000,
            "scouting/multicast/enabled": False,
            "transport/link/tx/lease": max(100, int(self._keep_alive_s * 1000)),
        }
        if self._credentials.user is not None and self._credentials.password_file is not None:
            settings["transport/auth/usrpwd/user"] = self._credentials.user
            settings["transport/auth/usrpwd/password"] = Path(self._credentials.password_file).read_text().rstrip("\r\n")
        if self._endpoint.startswith("tls/"):
            tls = self._credentials
            if tls.ca is None:
                raise ValueError("credentials.ca is not given, limit: required by tls/")
            settings["transport/link/tls/root_ca_certificate"] = os.fspath(tls.ca)
            if tls.cert is not None and tls.key is not None:
                settings["transport/link/tls/enable_mtls"] = True
                settings["transport/link/tls/connect_certificate"] = os.fspath(tls.cert)
                settings["transport/link/tls/connect_private_key"] = os.fspath(tls.key)
        config = zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return config


class _ZenohStream(Stream):
    def __init__(
        self, session: zenoh.Session, vehicle: str, requests: Iterator[bytes], token: str | None, renewed: bool
    ) -> None:
        self._session = session
        self._token = token
        # A token that is not believed may be another one by the next stream.
        self._transient = TRANSIENT | {UNAUTHENTICATED} if renewed else TRANSIENT
        self._nonce = secrets.token_hex(8)
        self._answers: queue.SimpleQueue[ingest.StreamObservationsResponse | StreamBroken] = queue.SimpleQueue()
        self._accepted = False
        self._cancelled = threading.Lock()
        recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        try:
            # Answers first: the one to the start must not be missed.
            self._subscribers = [
                ext.declare_advanced_subscriber(session, f"{vehicle}/{name}", self._take, recovery=recovery)
                for name in ("acks", "pose")
            ]
            liveliness = session.liveliness()
            self._alive = liveliness.declare_token(f"{vehicle}/@alive/{self._nonce}")
            self._server = liveliness.declare_subscriber(SERVER, self._take_server, history=True)
            self._publisher = ext.declare_advanced_publisher(
                session,
                f"{vehicle}/observations",
                encoding=ENCODING,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                cache=ext.CacheConfig(max_samples=256),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                publisher_detection=True,
            )
        except zenoh.ZError:
            session.close()  # type: ignore[no-untyped-call]
            raise
        threading.Thread(target=self._send, args=(requests,), name="lanemap zenoh", daemon=True).start()

    def answer(self) -> ingest.StreamObservationsResponse | None:
        try:
            answer = self._answers.get(timeout=None if self._accepted else ACCEPTED_WITHIN_S)
        except queue.Empty:
            raise StreamBroken("the service did not answer the start", transient=True) from None
        if isinstance(answer, StreamBroken):
            raise answer
        if answer.WhichOneof("message") == "closed":
            closed = answer.closed
            if closed.code == 0:
                return None
            retry_after_s = closed.retry_after_ms * 1e-3 if closed.HasField("retry_after_ms") else None
            raise StreamBroken(closed.message, transient=closed.code in self._transient, retry_after_s=retry_after_s)
        self._accepted = True
        return answer

    def cancel(self) -> None:
        if self._cancelled.acquire(blocking=False):
            self._answers.put(StreamBroken("the stream was given up", transient=True))
            self._session.close()  # type: ignore[no-untyped-call]

    def _send(self, requests: Iterator[bytes]) -> None:
        try:
            for number, request in enumerate(requests):
                attachment = f"{self._nonce}{number:016x}"
                if number == 0 and self._token is not None:
                    attachment += f" {self._token}"
                self._publisher.put(request, attachment=attachment)
            # No more is sent; what was sent is still answered, and then the stream is closed.
            self._alive.undeclare()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            self._answers.put(StreamBroken(f"zenoh: {error}", transient=True))

    def _take(self, sample: zenoh.Sample) -> None:
        if sample.attachment is None or not sample.attachment.to_string().startswith(self._nonce):
            return  # An answer to another stream of the vehicle.
        answer = ingest.StreamObservationsResponse.FromString(sample.payload.to_bytes())
        if answer.WhichOneof("message") in ("pose", "local_map") and self._answers.qsize() > MAX_UPDATES:
            return
        self._answers.put(answer)

    def _take_server(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._answers.put(StreamBroken("the service is gone", transient=True))
