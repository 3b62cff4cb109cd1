"""What a session does with a service that answers as a test wants it to."""

import queue
import tempfile
import unittest
from unittest import mock

import lanemap
from google.protobuf import any_pb2, duration_pb2
from lanemap import _grpc, _session
from lanemap._link import Link, Stream
from lanemap.errors import StreamBroken
from lanemap.v1 import ingest_service_pb2 as ingest

WITHIN_S = 20
CAMERA = lanemap.Sensor(lanemap.Pose(), axes="vehicle")


def accepted(**fields):
    return ingest.StreamObservationsResponse(accepted=ingest.SessionAccepted(session_id="0", **fields))


def ack(sequence):
    return ingest.StreamObservationsResponse(ack=ingest.Ack(acked_sequence_inclusive=sequence))


class Service(Link):
    """Gives streams whose answers the test puts in; a stream that was given up is broken."""

    def __init__(self):
        self.opened, self.answers = queue.Queue(), None

    def open(self, requests):
        stream = mock.Mock(spec=Stream)
        answers = queue.Queue()

        def answer():
            answer = answers.get(timeout=WITHIN_S)
            if isinstance(answer, Exception):
                raise answer
            return answer

        stream.answer.side_effect = answer
        stream.cancel.side_effect = lambda: answers.put(StreamBroken("given up", transient=True))
        self.opened.put((answers, requests))
        return stream

    def close(self):
        pass

    def next_stream(self):
        return self.opened.get(timeout=WITHIN_S)


def request(encoded):
    return ingest.StreamObservationsRequest.FromString(encoded)


class Sessions(unittest.TestCase):
    def session(self, **options):
        self.service = Service()
        folder = self.enterContext(tempfile.TemporaryDirectory())
        reconnect = lanemap.Reconnect(first_pause_s=0.0)
        with mock.patch.object(_session, "link_to", return_value=self.service):
            session = lanemap.Session(
                "http://test", fleet="f", vehicle="v", drive="d", sensor=CAMERA, spool=folder, reconnect=reconnect, **options
            )
        self.addCleanup(session.abandon)
        return session

    def test_no_more_frames_are_unacked_than_the_service_allows(self):
        session = self.session()
        for number in range(1, 6):
            session.send(number, lanemap.Pose())
        answers, requests = self.service.next_stream()
        self.assertEqual(request(next(requests)).WhichOneof("message"), "start")
        answers.put(accepted(limits=ingest.IngestLimits(
            max_detections=1, max_points_per_detection=2, max_point_range_m=1, max_message_bytes=10**6, max_frames_in_flight=2)))
        self.assertEqual([request(next(requests)).frame.sequence for _ in range(2)], [1, 2])
        self.assertEqual(session._backlog._sent, 2)
        answers.put(ack(1))
        self.assertEqual(request(next(requests)).frame.sequence, 3)

    def test_a_broken_stream_is_followed_by_one_that_sends_again_what_was_not_acked(self):
        session = self.session()
        for number in range(1, 4):
            session.send(number, lanemap.Pose())
        answers, requests = self.service.next_stream()
        next(requests)
        answers.put(accepted())
        self.assertEqual([request(next(requests)).frame.sequence for _ in range(3)], [1, 2, 3])
        answers.put(ack(1))
        answers.put(StreamBroken("tunnel", transient=True))
        with self.assertRaises(StopIteration):
            next(requests)  # The old stream's thread is told to go.
        answers, requests = self.service.next_stream()
        next(requests)
        answers.put(accepted(resume_after_sequence=2))
        self.assertEqual(request(next(requests)).frame.sequence, 3)
        self.assertEqual(session.acked, 2)

    def test_numbers_that_the_service_has_had_already_fail_the_session_rather_than_be_dropped(self):
        session = self.session()
        session.send(1, lanemap.Pose())
        answers, _ = self.service.next_stream()
        answers.put(accepted(resume_after_sequence=5))
        with self.assertRaisesRegex(lanemap.SessionError, "frames up to 5 are durable"):
            session.wait_acked(6, WITHIN_S)

    def test_what_another_try_cannot_mend_ends_the_session_and_whoever_waits_for_it(self):
        session = self.session()
        poses, acks = session.poses(), session.acks()
        session.send(1, lanemap.Pose())
        answers, _ = self.service.next_stream()
        answers.put(StreamBroken("a newer stream has taken over", transient=False))
        for waiting in (lambda: next(poses), lambda: next(acks), lambda: session.wait_acked(1), session.finish):
            with self.assertRaisesRegex(lanemap.SessionError, "taken over"):
                waiting()
        with self.assertRaises(lanemap.SessionError):
            session.send(2, lanemap.Pose())

    def test_a_spool_that_was_damaged_under_the_session_fails_it_instead_of_being_tried_for_ever(self):
        session = self.session()
        session.send(1, lanemap.Pose())
        segment = session._backlog._spool._segments[-1]
        segment.path.write_bytes(bytes(segment.size))
        answers, requests = self.service.next_stream()
        next(requests)
        answers.put(accepted())
        with self.assertRaises(StopIteration):
            next(requests)
        answers.put(None)
        with self.assertRaisesRegex(lanemap.SpoolError, "not what was written"):
            session.wait_acked(1, WITHIN_S)

    def test_pauses_grow_are_jittered_and_as_long_as_the_service_asks(self):
        reconnect = lanemap.Reconnect()
        for tries in range(40):
            bound = min(0.1 * 2**tries, 30)
            self.assertTrue(all(bound / 2 <= reconnect.pause_s(tries, None) <= bound for _ in range(50)))
            self.assertGreaterEqual(reconnect.pause_s(tries, 70.0), 70.0)
        self.assertEqual(len({reconnect.pause_s(6, None) for _ in range(10)}), 10)

    def test_the_services_wish_is_read_from_a_status(self):
        info = duration_pb2.Duration(seconds=1, nanos=500_000_000).SerializeToString()
        retry_info = b"\n" + bytes([len(info)]) + info
        detail = any_pb2.Any(type_url="type.googleapis.com/google.rpc.RetryInfo", value=retry_info).SerializeToString()
        status = b"\x08\x08\x12\x04busy\x1a" + bytes([len(detail)]) + detail
        call = mock.Mock()
        call.trailing_metadata.return_value = (("x", "y"), ("grpc-status-details-bin", status))
        self.assertEqual(_grpc._retry_after_s(call), 1.5)
        for cut in range(len(status)):
            call.trailing_metadata.return_value = (("grpc-status-details-bin", status[:cut]),)
            _grpc._retry_after_s(call)  # Whatever comes is read without a fault.

    def test_a_frame_is_enveloped_as_protobuf_does(self):
        for length in (0, 1, 127, 128, 5000):
            frame = ingest.StreamObservationsRequest().frame
            frame.sequence = 7
            if length:
                frame.detections.add(xyz=[1.0] * length)
            whole = ingest.StreamObservationsRequest(frame=frame)
            self.assertEqual(request(_session.frame_request(frame.SerializeToString())), whole)


if __name__ == "__main__":
    unittest.main()
