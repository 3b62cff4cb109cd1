"""The README's Python client against a real server: what it streams over gRPC comes out as lanes over HTTP.

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


class StreamDrive(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        command = [BINARY, "serve", "--listen", "127.0.0.1:0", "--data-dir", self.folder / "data"]
        self.server = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        self.addCleanup(self.stop)
        line = self.server.stdout.readline()
        self.address = re.search(r"http://(\S+?:\d+)", line).group(1)

    def stop(self):
        self.server.send_signal(signal.SIGTERM)
        self.server.stdout.close()
        self.assertEqual(self.server.wait(WITHIN_S), 0, "the server stops cleanly")

    def stream(self):
        command = [sys.executable, CLIENT, f"http://{self.address}"]
        done = subprocess.run(command, cwd=self.folder, text=True, capture_output=True, timeout=WITHIN_S)
        self.assertEqual(done.returncode, 0, done.stderr)
        return done.stdout

    def test_a_drive_streamed_from_python_is_acked_whole_and_served_as_its_two_lines(self):
        printed = self.stream()
        self.assertIn("Summary(acked=200, refused=0, reconnections=0)", printed)

        lanes = get(f"http://{self.address}/collections/lanes/items")["features"]
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


if __name__ == "__main__":
    unittest.main(verbosity=2)
