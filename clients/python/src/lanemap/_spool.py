"""The spool: frames on disk until the service has made them durable.

The same folders and files as those of the Rust client (clients/rust/src/spool.rs says what is where, and why): either
reads what the other has left. A process that is killed loses nothing that `append` has taken.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import struct
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Literal
from urllib.parse import quote

from google.protobuf.message import DecodeError

from . import _records
from ._records import HEADER, MAGIC, Kind
from .errors import SpoolError, SpoolFull
from .v1 import ingest_service_pb2, observation_pb2

MIN_BYTES = 64 * 1024
MAX_NAME_BYTES = 200


@dataclass(frozen=True)
class SpoolOptions:
    """Where frames wait on disk.

    `folder` holds one folder for each drive, FLEET/VEHICLE/DRIVE; a drive's folder goes when the drive has ended and
    all of it is acked. `max_bytes`, at least 65536, bounds all drives in it together. When there is no room for a
    frame, `Session.send` waits ("block") or raises `SpoolFull` ("refuse"): nothing that was taken is ever dropped.
    `sync` says when bytes are forced to disk, which is about the machine's power, for a killed process loses nothing
    anyway: seconds after the first unsynced frame, 0 before `send` returns, None by the operating system only.
    """

    folder: str | os.PathLike[str]
    max_bytes: int = 1024**3
    when_full: Literal["block", "refuse"] = "block"
    sync_s: float | None = 1.0

    def __post_init__(self) -> None:
        if self.max_bytes < MIN_BYTES:
            raise ValueError(f"spool.max_bytes is {self.max_bytes}, limit: at least {MIN_BYTES}")
        if self.when_full not in ("block", "refuse"):
            raise ValueError(f"spool.when_full is {self.when_full!r}, limit: 'block' or 'refuse'")
        if self.sync_s is not None and not self.sync_s >= 0:
            raise ValueError(f"spool.sync_s is {self.sync_s}, limit: at least 0, or None")

    @property
    def segment_bytes(self) -> int:
        """Length from which a segment is not added to any more."""
        return min(self.max_bytes // 8, 8 * 1024 * 1024)


@dataclass
class SpoolRecovery:
    """What a spool held when it was opened."""

    frames: int = 0
    torn_bytes: int = 0
    """Of a last record that was not written whole: the frame that was being sent when its writer was cut off."""
    damaged_bytes: int = 0
    """That are not what was written: frames that are lost. Above 0 only where the disk, or a hand, changed them."""


@dataclass
class _Segment:
    number: int
    file: IO[bytes]
    path: Path
    size: int
    unresolved: int = 0


@dataclass(frozen=True)
class _SpooledFrame:
    sequence: int
    segment: _Segment
    offset: int
    length: int


@dataclass
class Spool:
    """The spool of one drive. Not thread-safe: its backlog holds a lock."""

    options: SpoolOptions
    start: ingest_service_pb2.SessionStart
    recovery: SpoolRecovery = field(default_factory=SpoolRecovery)
    last_sequence: int | None = None
    ended: bool = False
    """Whether the drive was ended."""

    def __post_init__(self) -> None:
        self.folder = drive_folder(self.options.folder, self.start)
        self._segments: deque[_Segment] = deque()
        self._frames: deque[_SpooledFrame] = deque()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = open(self.folder / "lock", "ab")
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self._lock.close()
                raise SpoolError(f"the spool {self.folder} is in use by another process") from None
            self._others_bytes = _bytes_of_others(Path(self.options.folder), self.folder)
            self._recover()
        except OSError as error:
            raise self._disk(error) from error

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def size(self) -> int:
        """Bytes on disk."""
        return sum(segment.size for segment in self._segments)

    def append(self, message: observation_pb2.Frame) -> None:
        """Takes a frame, or raises `SpoolFull`."""
        record = _records.encode(Kind.FRAME, message.SerializeToString())
        most = self.options.max_bytes
        if self._others_bytes + self._opening_bytes + self._reserved_bytes + len(record) > most:
            raise ValueError(
                f"frame {message.sequence} has {len(record)} bytes, limit: what spool.max_bytes = {most} can ever hold"
            )
        try:
            if self._segments[-1].size >= self.options.segment_bytes or not self._has_room_for(len(record)):
                self._roll()
            if not self._has_room_for(len(record)):
                raise self._full()
            segment = self._segments[-1]
            offset = self._write(segment, record)
        except OSError as error:
            raise self._disk(error) from error
        self._note(segment, message.sequence, offset, len(record))

    def append_end(self) -> None:
        """Notes that the drive is over; there is always room for that."""
        if not self.ended:
            try:
                self._write(self._segments[-1], _records.encode(Kind.END, b""))
            except OSError as error:
                raise self._disk(error) from error
            self.ended = True

    def read(self, index: int) -> bytes:
        """The frame at `index`, oldest first, as `lanemap.v1.Frame`."""
        frame = self._frames[index]
        try:
            data = os.pread(frame.segment.file.fileno(), frame.length, frame.offset)
        except OSError as error:
            raise self._disk(error) from error
        record = _records.decode(data)
        if record is None:
            raise SpoolError(f"the spool {self.folder}: the record at byte {frame.offset} is not what was written")
        return record.body

    def sequence(self, index: int) -> int:
        """Number of the frame at `index`."""
        return self._frames[index].sequence

    def forget_up_to(self, sequence: int) -> int:
        """Forgets frames from the oldest on, up to `sequence`, inclusive; says how many."""
        forgotten = 0
        while self._frames and self._frames[0].sequence <= sequence:
            self._frames.popleft().segment.unresolved -= 1
            forgotten += 1
        self._delete_resolved()
        return forgotten

    def forget(self, sequence: int, among: int) -> bool:
        """Forgets the oldest frame of this number among the first `among`; says whether there was one."""
        for index in range(min(among, len(self._frames))):
            if self._frames[index].sequence == sequence:
                self._frames[index].segment.unresolved -= 1
                del self._frames[index]
                self._delete_resolved()
                return True
        return False

    def unsynced(self) -> int:
        """A descriptor, the caller's own, of the file that is being written; older ones are synced when left."""
        return os.dup(self._segments[-1].file.fileno())

    def close(self, *, delivered: bool) -> None:
        """Lets go; `delivered`: the drive has ended and the service has all of it, so its folder goes."""
        for segment in self._segments:
            segment.file.close()
        if delivered:
            for path in self.folder.iterdir():
                path.unlink()
            for folder in (self.folder, self.folder.parent, self.folder.parent.parent):
                try:
                    folder.rmdir()
                except OSError:
                    break  # Another drive of the vehicle or of the fleet.
        self._lock.close()

    def _recover(self) -> None:
        numbers = segment_numbers(self.folder)
        for number in numbers:
            self._recover_segment(number, newest=number == numbers[-1])
        self.recovery.frames = len(self._frames)
        if not numbers:
            self._begin_segment(0)
        elif self.recovery.damaged_bytes:
            # What is appended to a damaged file might not be found again.
            self._begin_segment(numbers[-1] + 1)
        self._delete_resolved()

    def _recover_segment(self, number: int, *, newest: bool) -> None:
        path = self.folder / segment_name(number)
        file = open(path, "r+b", buffering=0)
        data = file.read()
        contents = _records.read(data)
        kept = len(data) - contents.torn_bytes
        if contents.torn_bytes:
            file.truncate(kept)
        if kept == 0:
            os.pwrite(file.fileno(), MAGIC, 0)
        segment = _Segment(number, file, path, max(kept, len(MAGIC)))
        self._segments.append(segment)
        self.recovery.damaged_bytes += contents.damaged_bytes
        if newest:
            self.recovery.torn_bytes += contents.torn_bytes
        else:
            self.recovery.damaged_bytes += contents.torn_bytes
        for record in contents.records:
            self._take_record(segment, record)

    def _take_record(self, segment: _Segment, record: _records.Record) -> None:
        if record.kind == Kind.END:
            self.ended = True
        elif record.kind == Kind.MARK:
            if len(record.body) == 8:
                self._mark(*struct.unpack("<Q", record.body))
            else:
                self.recovery.damaged_bytes += record.length
        elif record.kind == Kind.FRAME:
            try:
                message = observation_pb2.Frame.FromString(record.body)
            except DecodeError:
                self.recovery.damaged_bytes += record.length
            else:
                self._note(segment, message.sequence, record.offset, record.length)

    def _note(self, segment: _Segment, sequence: int, offset: int, length: int) -> None:
        segment.unresolved += 1
        self._frames.append(_SpooledFrame(sequence, segment, offset, length))
        self._mark(sequence)

    def _mark(self, sequence: int) -> None:
        self.last_sequence = sequence if self.last_sequence is None else max(self.last_sequence, sequence)

    @property
    def _used_bytes(self) -> int:
        return self._others_bytes + self.size

    @property
    def _opening_bytes(self) -> int:
        """Length of a segment without frames."""
        return len(MAGIC) + 3 * HEADER.size + self.start.ByteSize() + 8

    @property
    def _reserved_bytes(self) -> int:
        """Kept free for the opening of the next segment, which is written before an old one goes, and for an end."""
        return self._opening_bytes + HEADER.size

    def _has_room_for(self, record_bytes: int) -> bool:
        return self._used_bytes + record_bytes + self._reserved_bytes <= self.options.max_bytes

    def _roll(self) -> None:
        """Begins a new segment where that helps: the newest is long enough, or all of it is resolved and it can go."""
        newest = self._segments[-1]
        can_go = newest.unresolved == 0 and newest.size > self._opening_bytes
        one_more = newest.size >= self.options.segment_bytes and self._has_room_for(self._opening_bytes)
        if can_go or one_more:
            if self.options.sync_s is not None:
                os.fsync(newest.file.fileno())
            # The new one bears the mark before the old one goes: numbers are never given twice.
            self._begin_segment(newest.number + 1)
            self._delete_resolved()

    def _begin_segment(self, number: int) -> None:
        path = self.folder / segment_name(number)
        file = open(path, "x+b", buffering=0)
        segment = _Segment(number, file, path, 0)
        opening = MAGIC + _records.encode(Kind.START, self.start.SerializeToString())
        if self.last_sequence is not None:
            opening += _records.encode(Kind.MARK, struct.pack("<Q", self.last_sequence))
        if self.ended:
            opening += _records.encode(Kind.END, b"")
        try:
            self._write(segment, opening)
        except OSError:
            file.close()
            path.unlink()
            raise
        self._segments.append(segment)
        if self.options.sync_s is not None:
            # Without this, power loss could take the file's name.
            folder = os.open(self.folder, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def _write(self, segment: _Segment, record: bytes) -> int:
        """Appends; what could not be written whole is taken back."""
        offset, written = segment.size, 0
        try:
            while written < len(record):
                written += os.pwrite(segment.file.fileno(), record[written:], offset + written)
        except OSError:
            os.ftruncate(segment.file.fileno(), offset)
            raise
        segment.size += len(record)
        return offset

    def _delete_resolved(self) -> None:
        """Deletes segments of which nothing is left, from the oldest on; the newest stays, for its mark."""
        while len(self._segments) > 1 and self._segments[0].unresolved == 0:
            segment = self._segments.popleft()
            segment.file.close()
            segment.path.unlink(missing_ok=True)

    def _full(self) -> SpoolFull:
        return SpoolFull(f"the spool {self.folder} is full: {self._used_bytes} bytes of {self.options.max_bytes}")

    def _disk(self, error: OSError) -> SpoolError:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return self._full()
        return SpoolError(f"the spool {self.folder}: {error}")


def segment_name(number: int) -> str:
    """Name of a segment's file: twenty digits, so that names sort as numbers do."""
    return f"{number:020}.spool"


def segment_numbers(folder: Path) -> list[int]:
    """The numbers of the segments in a drive's folder, oldest first."""
    stems = [path.stem for path in folder.glob("*.spool")]
    return sorted(int(stem) for stem in stems if stem.isdecimal() and segment_name(int(stem)) == f"{stem}.spool")


def drive_folder(spool: str | os.PathLike[str], start: ingest_service_pb2.SessionStart) -> Path:
    """The folder of a drive."""
    return Path(spool, *(_folder_name(name) for name in (start.fleet_id, start.vehicle_id, start.drive_id)))


def _folder_name(name: str) -> str:
    """Percent-encoded, a dot at the beginning too, so that no id leads out of the spool."""
    quoted = quote(name, safe="")
    if quoted.startswith("."):
        quoted = "%2E" + quoted[1:]
    if len(quoted) <= MAX_NAME_BYTES:
        return quoted
    return f"%sha256-{hashlib.sha256(name.encode()).hexdigest()}"


def _bytes_of_others(spool: Path, but: Path) -> int:
    total = 0
    for path in spool.glob("*/*/*/*.spool"):
        if path.parent != but:
            try:
                total += path.stat().st_size
            except FileNotFoundError:
                pass  # Another process has just delivered it.
    return total
