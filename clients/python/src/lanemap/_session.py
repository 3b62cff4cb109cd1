"""One drive that is streamed."""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import TypeVar

import numpy.typing as npt

from . import _values
from ._backlog import Backlog, Leaving
from ._events import Feed, Gap, LocalMap, Refusal, Summary, VehiclePose
from ._link import Credentials, Link, Stream, link_to
from ._spool import Spool, SpoolOptions, SpoolRecovery
from ._values import Detection, GnssFix, Limits, Occlusion, Pose, Preset, Sensor
from .errors import LanemapError, Refused, SessionError, SpoolError, StreamBroken
from .v1 import ingest_service_pb2 as ingest

T = TypeVar("T")


@dataclass(frozen=True)
class Reconnect:
    """How often, and for how long, a broken connection is tried again.

    The pause doubles from try to try, up to the longest. Each is drawn at random between half of that and all of it, so
    that a fleet that lost one server does not come back in one moment; where the service said how long to wait, it is
    at least that long. After `max_tries` without any progress the session fails; `None`: never.
    """

    max_tries: int | None = None
    first_pause_s: float = 0.1
    longest_pause_s: float = 30.0

    def pause_s(self, tries: int, retry_after_s: float | None) -> float:
        """The pause before the try after `tries` that failed."""
        longest = min(self.first_pause_s * 2.0 ** min(tries, 16), self.longest_pause_s)
        jittered = longest * random.uniform(0.5, 1.0)
        if retry_after_s is not None and retry_after_s > jittered:
            return retry_after_s + longest * random.uniform(0.0, 0.5)
        return jittered


class Session:
    """Streams one drive to a service, over gRPC (http://HOST:PORT, https://) or zenoh (tcp/HOST:PORT, tls/).

    `fleet`, `vehicle` and `drive` together name the drive: the same names resume it. Without a spool the session waits
    until the service has accepted it, keeps `max_unacked` frames in memory to be sent again, and `send` waits while so
    many are unacked. With a spool (a folder, or `SpoolOptions`) frames wait on disk: the session begins without a
    service too, outlives the process, and resumes after it. A drive that was begun with a spool is to be resumed with it:
    it knows which numbers its frames have.

    As a context, the session ends the drive (`finish`) where the block ends well, and leaves it as it is where the
    block raises.
    """

    def __init__(
        self,
        url: str,
        *,
        fleet: str,
        vehicle: str,
        drive: str,
        sensor: Sensor,
        preset: Preset = "default",
        local_map: bool = False,
        spool: SpoolOptions | str | os.PathLike[str] | None = None,
        max_unacked: int = 64,
        reconnect: Reconnect = Reconnect(),
        credentials: Credentials = Credentials(),
        keep_alive_s: float = 20.0,
        open_timeout_s: float = 20.0,
    ) -> None:
        if max_unacked < 1:
            raise ValueError(f"max_unacked is {max_unacked}, limit: at least 1")
        self._start = _values.start(fleet, vehicle, drive, sensor, preset, local_map)
        self._link: Link = link_to(url, self._start, credentials, keep_alive_s)
        options = spool if spool is None or isinstance(spool, SpoolOptions) else SpoolOptions(spool)
        self._backlog = Backlog(None if options is None else Spool(options, self._start), max_unacked)
        self._max_unacked, self._reconnect, self._open_timeout_s = max_unacked, reconnect, open_timeout_s
        self._patient = options is not None
        self._changed = threading.Condition()
        self._accepted: ingest.SessionAccepted | None = None
        self._limits = Limits()
        self._next_sequence = (self._backlog.last_sequence or 0) + 1
        self._numbered_blindly_from: int | None = None
        self._last_time_ns: int | None = None
        self._summary = Summary()
        self._over = False
        self._error: Exception | None = None
        self._gone = threading.Event()
        self._stream: Stream | None = None
        self._sending_failed: SpoolError | None = None
        self._feeds: dict[type, list[Feed[object]]] = {}
        self._thread = threading.Thread(target=self._run, name=f"lanemap {drive}", daemon=True)
        self._thread.start()
        if not self._patient:
            self.wait_opened()

    # What the owner does.

    def send(
        self,
        time_ns: int,
        pose: Pose | npt.ArrayLike,
        detections: Iterable[Detection | npt.ArrayLike] = (),
        *,
        gnss: GnssFix | None = None,
        motion_covariance: npt.ArrayLike | None = None,
        occlusions: Iterable[Occlusion] = (),
        sequence: int | None = None,
        timeout_s: float | None = None,
    ) -> int:
        """Takes a frame; gives its number, which is one more than the last where `sequence` does not say.

        `time_ns` is the time of measurement since the Unix epoch, `pose` is odometry_from_vehicle (a `Pose` or a 4x4
        matrix), each detection a `Detection` or an (n, 3) array, `occlusions` what other
        vehicles hide, where an object detector knows. Raises `ValueError` for what the service would refuse,
        `SpoolFull` where the spool is full and told to refuse, `TimeoutError` where no room came in time (the frame is
        not taken in each of these, and the session goes on), and `SessionError` where the session has failed.
        """
        with self._changed:
            self._raise_if_failed()
            number = self._next_sequence if sequence is None else sequence
        message = _values.frame(number, time_ns, pose, detections, gnss, motion_covariance, self._limits, occlusions)
        if number < self._next_sequence:
            raise ValueError(f"sequence is {number}, limit: above {self._next_sequence - 1}, the last one taken")
        if self._last_time_ns is not None and time_ns <= self._last_time_ns:
            raise ValueError(f"time_ns is {time_ns}, limit: above {self._last_time_ns}, that of the frame before")
        with self._changed:
            if sequence is None and self._accepted is None and self._backlog.last_sequence is None:
                self._numbered_blindly_from = number
        try:
            self._backlog.push(message, timeout_s)
        except SessionError:
            with self._changed:
                self._raise_if_failed()
            raise
        with self._changed:
            self._next_sequence, self._last_time_ns = max(self._next_sequence, number + 1), time_ns
        return number

    def finish(self) -> Summary:
        """Ends the drive; returns once all of it is durable and in the map. No frame can be added later."""
        return self._leave(Leaving.END)

    def close(self) -> Summary:
        """Leaves the drive open, to be resumed; returns once every frame taken is durable or refused."""
        return self._leave(Leaving.CLOSE)

    def abandon(self) -> None:
        """Leaves at once; what is not acked is lost where there is no spool."""
        with self._changed:
            self._over = True
            stream = self._stream
        self._gone.set()
        if stream is not None:
            stream.cancel()
        self._backlog.close(delivered=False)
        self._thread.join()

    def wait_opened(self, timeout_s: float | None = None) -> None:
        """Waits until the service has accepted the session for the first time."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._accepted is not None or self._over, timeout_s):
                raise TimeoutError(f"no service has accepted the session within {timeout_s} s")
            if self._accepted is None:
                self._raise_if_failed()

    def wait_acked(self, sequence: int, timeout_s: float | None = None) -> None:
        """Waits until the frame `sequence`, or a later one, is durable."""

        def acked() -> bool:
            return self._summary.acked is not None and self._summary.acked >= sequence

        with self._changed:
            if not self._changed.wait_for(lambda: acked() or self._over, timeout_s):
                raise TimeoutError(f"frame {sequence} was not acked within {timeout_s} s")
            if not acked():
                self._raise_if_failed()
                raise SessionError(f"the session is over, and frame {sequence} was not acked")

    @property
    def id(self) -> str | None:
        """The service's name of the session, as in /sessions/{id}; `None` until the service has accepted it."""
        return None if self._accepted is None else self._accepted.session_id

    @property
    def resume_after(self) -> int | None:
        """Last frame that was durable when the session was first accepted."""
        accepted = self._accepted
        return accepted.resume_after_sequence if accepted and accepted.HasField("resume_after_sequence") else None

    @property
    def acked(self) -> int | None:
        """Last frame known to be durable, inclusive."""
        return self._summary.acked

    @property
    def last_sequence(self) -> int | None:
        """Highest number of a frame of the drive that was ever taken, as far as the spool and the service know."""
        return self._next_sequence - 1 if self._next_sequence > 1 else None

    @property
    def limits(self) -> Limits:
        """What the service takes."""
        return self._limits

    @property
    def recovery(self) -> SpoolRecovery | None:
        """What the spool held when the session began."""
        return self._backlog.recovery

    def acks(self) -> Iterator[int]:
        """The last durable frame whenever there is a newer one, until the session is over."""
        last: int | None = None
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._summary.acked != last or self._over)
                if self._summary.acked == last:
                    self._raise_if_failed()
                    return
                last = self._summary.acked
            if last is not None:
                yield last

    def poses(self) -> Feed[VehiclePose]:
        """Where the vehicle is, frame by frame, from now on."""
        return self._feed(VehiclePose)

    def local_maps(self) -> Feed[LocalMap]:
        """The map around the vehicle, frame by frame, from now on; of a session that asked for `local_map`."""
        return self._feed(LocalMap)

    def refusals(self) -> Feed[Refusal]:
        """Frames that the service refuses, from now on."""
        return self._feed(Refusal)

    def gaps(self) -> Feed[Gap]:
        """Frames that did not come and that the service no longer waits for, from now on."""
        return self._feed(Gap)

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._thread.is_alive() and kind is not None:
            self.abandon()
        elif not self._over or self._error is not None:
            self.finish()

    def _leave(self, leaving: Leaving) -> Summary:
        self._backlog.leave(leaving)
        self._thread.join()
        with self._changed:
            self._raise_if_failed()
            return self._summary

    def _feed(self, kind: type[T]) -> Feed[T]:
        feed: Feed[T] = Feed()
        with self._changed:
            self._feeds.setdefault(kind, []).append(feed)  # type: ignore[arg-type]
            if self._over:
                feed.close(self._error)
        return feed

    def _raise_if_failed(self) -> None:
        if self._error is not None:
            raise self._error

    # What the session's thread does.

    def _run(self) -> None:
        error: Exception | None = None
        delivered = False
        try:
            delivered = self._stream_until_done()
        except Exception as failure:
            error = failure if isinstance(failure, LanemapError) else SessionError(f"the session failed: {failure!r}")
            if error is not failure:
                error.__cause__ = failure
        try:
            self._backlog.close(delivered=delivered)
            self._link.close()
        except OSError as failure:
            error = error or SessionError(f"the session could not be closed: {failure}")
        with self._changed:
            self._over, self._error = True, error
            self._changed.notify_all()
            for feeds in self._feeds.values():
                for feed in feeds:
                    feed.close(error)

    def _stream_until_done(self) -> bool:
        """Whether the drive has ended, and the service has all of it."""
        tries = 0
        while True:
            acked_before = self._summary.acked, self._summary.refused
            try:
                return self._one_stream()
            except StreamBroken as broken:
                first = self._accepted is None
                if self._gone.is_set():
                    return False
                if not broken.transient or (first and not self._patient):
                    raise SessionError(str(broken)) from broken
                if acked_before != (self._summary.acked, self._summary.refused):
                    tries = 0
                if self._reconnect.max_tries is not None and tries >= self._reconnect.max_tries:
                    raise SessionError(f"given up after {tries} tries: {broken}") from broken
                self._summary.reconnections += int(not first)
                self._gone.wait(self._reconnect.pause_s(tries, broken.retry_after_s))
                tries += 1

    def _one_stream(self) -> bool:
        number = self._backlog.begin_stream()
        stream = self._link.open(self._requests(number))
        with self._changed:
            self._stream = stream
        # A service that takes too long to accept is given up; from then on it is the connection's own watch.
        too_late = threading.Timer(self._open_timeout_s, stream.cancel)
        too_late.daemon = True
        too_late.start()
        try:
            if self._gone.is_set():
                return False
            accepted = self._first_answer(stream.answer())
            too_late.cancel()
            self._take_accepted(accepted)
            if accepted.ended and self._backlog.leaving is Leaving.END and not len(self._backlog):
                return True
            while (answer := stream.answer()) is not None:
                self._hear(answer)
            if self._sending_failed is not None:
                raise self._sending_failed
            if self._backlog.leaving is not None and not len(self._backlog):
                return self._backlog.leaving is Leaving.END
            raise StreamBroken("the stream ended", transient=True)
        finally:
            too_late.cancel()
            self._backlog.begin_stream()  # Whoever still sends on the old one goes.
            stream.cancel()

    def _requests(self, stream: int) -> Iterator[bytes]:
        yield ingest.StreamObservationsRequest(start=self._start).SerializeToString()
        while True:
            try:
                following = self._backlog.next(stream)
            except SpoolError as error:
                self._sending_failed = error  # The stream ends here; its other side says so.
                return
            if isinstance(following, bytes):
                yield frame_request(following)
                continue
            if following is Leaving.END:
                yield ingest.StreamObservationsRequest(end=ingest.SessionEnd()).SerializeToString()
            return

    def _first_answer(self, answer: ingest.StreamObservationsResponse | None) -> ingest.SessionAccepted:
        if answer is None:
            raise StreamBroken("the stream ended before the session was accepted", transient=True)
        if answer.WhichOneof("message") == "accepted":
            return answer.accepted
        if answer.WhichOneof("message") == "refusal":
            refusal = answer.refusal
            raise Refused(refusal.field, refusal.value, refusal.limit, refusal.message)
        raise SessionError(f"the service answered {answer.WhichOneof('message')} before it accepted the session")

    def _take_accepted(self, accepted: ingest.SessionAccepted) -> None:
        resume_after = accepted.resume_after_sequence if accepted.HasField("resume_after_sequence") else None
        limits = Limits.of(accepted.limits)
        first = self._accepted is None
        with self._changed:
            blindly_from = self._numbered_blindly_from
            if first and blindly_from is not None and resume_after is not None and resume_after >= blindly_from:
                raise SessionError(
                    f"the drive was streamed before without this spool: frames up to {resume_after} are durable, and the "
                    f"spool numbered its own from {blindly_from}; give the drive another name, or send sequence="
                )
            self._limits = limits
            if resume_after is not None:
                self._next_sequence = max(self._next_sequence, resume_after + 1)
                self._summary.acked = max(self._summary.acked or 0, resume_after)
            if first:
                self._accepted = accepted
            self._changed.notify_all()
        window = min(self._max_unacked, limits.max_frames_in_flight or self._max_unacked)
        self._backlog.open_stream(window, resume_after)

    def _hear(self, answer: ingest.StreamObservationsResponse) -> None:
        kind = answer.WhichOneof("message")
        if kind == "ack":
            self._backlog.acked(answer.ack.acked_sequence_inclusive)
            with self._changed:
                self._summary.acked = answer.ack.acked_sequence_inclusive
                self._changed.notify_all()
        elif kind == "refusal":
            refusal = answer.refusal
            sequence = refusal.sequence if refusal.HasField("sequence") else None
            if sequence is not None:
                self._backlog.refused(sequence)
            self._summary.refused += 1
            self._tell(Refusal(sequence, refusal.field, refusal.value, refusal.limit, refusal.message))
        elif kind == "gap":
            self._tell(Gap(answer.gap.first_missing_sequence, answer.gap.last_missing_sequence))
        elif kind == "pose":
            pose = answer.pose
            covariance = _values.covariance_of(pose.covariance)
            self._tell(VehiclePose(pose.sequence, Pose.of(pose.map_from_vehicle), covariance))
        elif kind == "local_map":
            update = answer.local_map
            born, grown, dropped = tuple(update.born), tuple(update.grown), tuple(update.dropped)
            self._tell(LocalMap(update.sequence, tuple(update.lanes), born, grown, dropped))

    def _tell(self, event: object) -> None:
        with self._changed:
            feeds = self._feeds.get(type(event), ())
        for feed in feeds:
            feed.put(event)


def frame_request(frame: bytes) -> bytes:
    """`StreamObservationsRequest{frame}` around a frame that is encoded already."""
    head = bytearray([ingest.StreamObservationsRequest.FRAME_FIELD_NUMBER << 3 | 2])
    length = len(frame)
    while length >= 0x80:
        head.append(length & 0x7F | 0x80)
        length >>= 7
    head.append(length)
    return bytes(head) + frame


