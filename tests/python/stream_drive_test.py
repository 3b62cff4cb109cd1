"""The Python client against a real server: the README's example, and what a session promises.

    python tests/python/stream_drive_test.py target/debug/lanemap     (with ./clients/python installed)
"""
import json
import math
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import unittest
import urllib.request

import lanemap
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[2]
CLIENT = ROOT / "clients/python/stream_drive.py"
BINARY = pathlib.Path(sys.argv.pop(1) if len(sys.argv) > 1 else ROOT / "target/debug/lanemap").resolve()
WITHIN_S = 60

# The road that the client drives: 200 m of a bend of 300 m radius around (0, 300), a line 1.75 m to each side.
HOME = (11.6, 48.1)
BEND_RADIUS_M = 300.0
LINES_APART_M = 3.5
LEAST_LENGTH_M = 180.0


def get(url):
    with urllib.request.urlopen(url, timeout=WITHIN_S) as response:
        return json.load(response)


class Served(unittest.TestCase):
    """A server of the test's own."""

    SETTINGS = ()

    def setUp(self):
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        command = [BINARY, "serve", "--listen", "127.0.0.1:0", "--data-dir", self.folder / "data", *self.SETTINGS]
        self.server = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        self.addCleanup(self.stop)
        line = self.server.stdout.readline()
        self.address = re.search(r"http://(\S+?:\d+)", line).group(1)

    def stop(self):
        self.server.send_signal(signal.SIGTERM)
        self.server.stdout.close()
        self.assertEqual(self.server.wait(WITHIN_S), 0, "the server stops cleanly")


class StreamDrive(Served):
    def stream(self):
        command = [sys.executable, CLIENT, f"http://{self.address}"]
        done = subprocess.run(command, cwd=self.folder, text=True, capture_output=True, timeout=WITHIN_S)
        self.assertEqual(done.returncode, 0, done.stderr)
        return done.stdout

    def test_a_drive_streamed_from_python_is_acked_whole_and_served_as_its_two_lines(self):
        printed = self.stream()
        self.assertIn("Summary(acked=200, refused=0, reconnections=0)", printed)

        lanes = get(f"http://{self.address}/collections/drives/items")["features"]
        self.assertEqual(len(lanes), 2)
        for lane in lanes:
            for longitude, latitude, *_ in lane["geometry"]["coordinates"]:
                self.assertLess(math.hypot(longitude - HOME[0], latitude - HOME[1]), 0.005)

        (session,) = re.findall(r"of session (\w+)", printed)
        local = get(f"http://{self.address}/sessions/{session}/lanes.geojson?crs=local")["features"]
        (inner, inner_length), (outer, outer_length) = sorted(self.radius_and_length(lane) for lane in local)
        self.assertAlmostEqual(outer - inner, LINES_APART_M, delta=0.1)
        self.assertAlmostEqual((inner + outer) / 2, BEND_RADIUS_M, delta=1.0)
        self.assertGreater(min(inner_length, outer_length), LEAST_LENGTH_M)

    @staticmethod
    def radius_and_length(lane):
        """Mean distance of a line from the bend's centre, and its length."""
        points = lane["geometry"]["coordinates"]
        radii = [math.hypot(x, y - BEND_RADIUS_M) for x, y, *_ in points]
        return sum(radii) / len(radii), sum(map(math.dist, points, points[1:]))



class Sessions(Served):
    SETTINGS = ("--max-detections", "2")

    def session(self, drive, url=None, **options):
        camera = lanemap.Sensor(lanemap.Pose(1.5, 0, 1.6), axes="vehicle")
        url = url or f"http://{self.address}"
        return lanemap.Session(url, fleet="tests", vehicle="car", drive=drive, sensor=camera, **options)

    def send(self, session, numbers, lines=2):
        ahead = np.arange(5.0, 50.0, 3.0)
        for number in numbers:
            detections = [np.column_stack([ahead, 0 * ahead + 3.5 * line, 0 * ahead]) for line in range(lines)]
            session.send(number * 100_000_000, lanemap.Pose(x=float(number)), detections)

    def test_acks_poses_and_local_maps_come_while_the_drive_is_streamed_and_end_with_it(self):
        with self.session("heard", local_map=True) as session:
            poses, maps, acks = session.poses(), session.local_maps(), session.acks()
            self.send(session, range(1, 41))
            session.wait_acked(40, WITHIN_S)
            self.assertEqual(session.finish().acked, 40)
        acks = list(acks)
        self.assertEqual((acks, acks[-1]), (sorted(set(acks)), 40))
        poses = list(poses)
        self.assertEqual(poses[-1].sequence, 40)
        self.assertAlmostEqual(poses[-1].map_from_vehicle.x, 39, delta=1)
        self.assertEqual(poses[-1].covariance.shape, (6, 6))
        self.assertEqual(len(list(maps)[-1].lanes), 2)

    def test_a_drive_that_was_left_goes_on_with_the_next_number(self):
        session = self.session("resumed")
        self.send(session, range(1, 6))
        self.assertEqual(session.close().acked, 5)
        with self.session("resumed") as session:
            self.assertEqual((session.resume_after, session.last_sequence), (5, 5))
            self.send(session, range(6, 9))
            self.assertEqual(session.finish().acked, 8)

    def test_what_the_services_own_limits_refuse_is_refused_here_once_they_are_known(self):
        with self.session("limited") as session:
            with self.assertRaisesRegex(ValueError, "detections has 3 entries, limit: 2"):
                self.send(session, [1], lines=3)
            self.send(session, [1])

    def test_a_frame_that_was_spooled_before_the_limits_were_known_is_refused_by_the_service_alone(self):
        spool = self.folder / "spool"
        offline = self.session("refused", url="http://127.0.0.1:1", spool=spool)
        self.send(offline, [1])
        self.send(offline, [2], lines=3)
        self.send(offline, [3])
        offline.abandon()
        session = self.session("refused", spool=spool)
        refusals = session.refusals()
        summary = session.finish()
        self.assertEqual((summary.acked, summary.refused), (3, 1))
        (refusal,) = refusals
        self.assertEqual((refusal.sequence, refusal.field, refusal.value), (2, "frame.detections", "3 entries"))

    def test_a_start_that_the_service_refuses_says_why(self):
        self.session("begun").close()
        with self.assertRaises(lanemap.Refused) as raised:
            self.session("begun", preset="paper")
        self.assertIn("preset", raised.exception.field)

    def test_a_service_that_is_not_there_is_said_at_once_where_there_is_no_spool(self):
        with self.assertRaisesRegex(lanemap.SessionError, "UNAVAILABLE"):
            self.session("nowhere", url="http://127.0.0.1:1")


if __name__ == "__main__":
    unittest.main(verbosity=2)
