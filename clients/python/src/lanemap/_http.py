"""HTTP as the map is read: one pool of connections, answers kept by their entity tags, patience with a busy service.

urllib3, and no more: it is typed, needs nothing else, keeps connections, streams bodies, and knows `Retry-After`.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from typing import Any
from urllib.parse import urlencode, urljoin, urlsplit

import urllib3
from urllib3.response import BaseHTTPResponse

from ._link import Credentials
from .errors import MapError, MapUnreachable

BUSY = (502, 503, 504)


class Http:
    """GETs below one address. Threads may share it."""

    def __init__(
        self, url: str, credentials: Credentials, *, timeout_s: float, retries: int, cache_bytes: int
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"url is {url!r}, limit: http:// or https://, then HOST:PORT, and a path where a proxy adds one")
        if parts.query or parts.fragment:
            raise ValueError(f"url is {url!r}, limit: neither a query nor a fragment")
        self.base = url.rstrip("/")
        self._origin = (parts.scheme, parts.netloc)
        self._credentials = credentials
        self._retry = urllib3.Retry(
            total=retries,
            status_forcelist=BUSY,
            allowed_methods=["GET"],
            backoff_factor=0.2,
            backoff_jitter=0.2,
            backoff_max=10.0,
            redirect=0,
            raise_on_status=False,
        )
        files = (credentials.ca, credentials.cert, credentials.key)
        ca, cert, key = (None if file is None else str(file) for file in files)
        self._pool = urllib3.PoolManager(
            maxsize=8, timeout=urllib3.Timeout(timeout_s), ca_certs=ca, cert_file=cert, key_file=key
        )
        self._kept: OrderedDict[str, tuple[str, bytes]] = OrderedDict()
        self._kept_bytes, self._most_bytes = 0, cache_bytes
        self._lock = threading.Lock()

    def address(self, path: str, **parameters: Any) -> str:
        """The address of a path, which begins with a slash; parameters that are `None` are left out."""
        given = {name: value for name, value in parameters.items() if value is not None}
        return f"{self.base}{path}" + (f"?{urlencode(given, safe=',:/')}" if given else "")

    def beside(self, address: str, link: str) -> str:
        """Where a link of an answer leads. One to another host is refused: it would be told the token."""
        joined = urljoin(address, link)
        parts = urlsplit(joined)
        if (parts.scheme, parts.netloc) != self._origin:
            raise MapError(f"{address} links to another host: {joined}")
        return joined

    def json(self, address: str) -> Any:
        """An answer as JSON."""
        try:
            return json.loads(self.body(address))
        except ValueError as error:
            raise MapError(f"{address} is no JSON: {error}") from None

    def body(self, address: str) -> bytes:
        """The body of an answer; asked for again, it travels only where it has changed."""
        with self._lock:
            kept = self._kept.get(address)
        headers = {} if kept is None else {"If-None-Match": kept[0]}
        response = self.open(address, headers, preload=True)
        if response.status == 304 and kept is not None:
            self._keep(address, *kept)
            return kept[1]
        tag = response.headers.get("ETag")
        if tag is not None:
            self._keep(address, tag, response.data)
        return response.data

    def open(
        self, address: str, headers: dict[str, str], *, preload: bool, timeout_s: float | None = None, retry: bool = True
    ) -> BaseHTTPResponse:
        """An answer that is no refusal; without `preload`, its body is still to be read, and the answer to be closed."""
        sent = {"Accept-Encoding": "gzip", **headers}
        token = self._credentials.bearer()
        if token is not None:
            sent["Authorization"] = f"Bearer {token}"
        options: dict[str, Any] = {} if timeout_s is None else {"timeout": urllib3.Timeout(timeout_s)}
        try:
            response = self._pool.request(
                "GET",
                address,
                headers=sent,
                preload_content=preload,
                retries=self._retry if retry else False,
                **options,
            )
        except urllib3.exceptions.HTTPError as error:
            raise MapUnreachable(f"{address}: {error}") from None
        if response.status not in (200, 304):
            try:
                raise MapError.of(address, response.status, response.data, response.headers.get("Retry-After"))
            finally:
                response.release_conn()
        return response

    def close(self) -> None:
        self._pool.clear()

    def _keep(self, address: str, tag: str, body: bytes) -> None:
        with self._lock:
            before = self._kept.pop(address, None)
            self._kept_bytes -= len(before[1]) if before is not None else 0
            if len(body) > self._most_bytes:
                return
            self._kept[address] = (tag, body)
            self._kept_bytes += len(body)
            while self._kept_bytes > self._most_bytes:
                _, (_, dropped) = self._kept.popitem(last=False)
                self._kept_bytes -= len(dropped)
