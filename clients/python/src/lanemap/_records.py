"""The records of a spool's segment files, as clients/rust/src/spool/record.rs describes them.

    segment = "lmspool1" record*
    record  = marker:[u8; 4] length:u32 crc:u32 kind:u8 body:[u8; length]        little-endian
    crc     = CRC-32 (IEEE, as in zlib) of length, kind and body

After damage, whatever it was, a reader goes on at the next marker that begins a whole record.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from enum import IntEnum

MAGIC = b"lmspool1"
MARKER = b"\xf5lmr"
HEADER = struct.Struct("<4sIIB")


class Kind(IntEnum):
    """What a record holds."""

    START = 1
    """`lanemap.v1.SessionStart`."""
    MARK = 2
    """`u64`: the highest sequence spooled before this segment."""
    FRAME = 3
    """`lanemap.v1.Frame`."""
    END = 4
    """No body: the drive is over."""


@dataclass(frozen=True)
class Record:
    """A record, and where it lies in its file."""

    kind: Kind
    body: bytes
    offset: int

    @property
    def length(self) -> int:
        """With its header."""
        return HEADER.size + len(self.body)


@dataclass
class Contents:
    """What a segment holds."""

    records: list[Record] = field(default_factory=list)
    torn_bytes: int = 0
    """Of a last record that its writer did not finish."""
    damaged_bytes: int = 0
    """That are not what was written."""


def encode(kind: Kind, body: bytes) -> bytes:
    """The bytes of a record."""
    length = len(body)
    return HEADER.pack(MARKER, length, _checksum(length, kind, body), kind) + body


def decode(data: bytes, at: int = 0) -> Record | None:
    """The record at a place; `None` where there is none, or not all of it."""
    if len(data) - at < HEADER.size:
        return None
    marker, length, crc, kind = HEADER.unpack_from(data, at)
    body = data[at + HEADER.size : at + HEADER.size + length]
    whole = marker == MARKER and len(body) == length and kind in Kind._value2member_map_
    return Record(Kind(kind), body, at) if whole and _checksum(length, kind, body) == crc else None


def read(data: bytes) -> Contents:
    """Every record of a segment."""
    contents = Contents()
    if not data.startswith(MAGIC):
        if MAGIC.startswith(data):
            contents.torn_bytes = len(data)
        else:
            contents.damaged_bytes = len(data)
        return contents
    at = len(MAGIC)
    while at < len(data):
        if (record := decode(data, at)) is not None:
            contents.records.append(record)
            at += record.length
        elif (following := _next_record(data, at)) is not None:
            contents.damaged_bytes += following - at
            at = following
        elif _is_torn(data, at):
            contents.torn_bytes = len(data) - at
            break
        else:
            contents.damaged_bytes += len(data) - at
            break
    return contents


def _next_record(data: bytes, at: int) -> int | None:
    while (at := data.find(MARKER, at + 1)) >= 0:
        if decode(data, at) is not None:
            return at
    return None


def _is_torn(data: bytes, at: int) -> bool:
    rest = data[at : at + HEADER.size]
    if len(rest) < HEADER.size:
        return MARKER.startswith(rest[: len(MARKER)])
    marker, length, _, _ = HEADER.unpack(rest)
    return bool(marker == MARKER and at + HEADER.size + length > len(data))


def _checksum(length: int, kind: int, body: bytes) -> int:
    return zlib.crc32(body, zlib.crc32(struct.pack("<IB", length, kind)))
