"""The Python map client against a real server: what it reads is the map, and it misses no change, whatever happens.

    python tests/python/map_test.py target/debug/lanemap     (with ./clients/python installed)
"""
import pathlib
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import unittest

import lanemap
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[2]
CLIENT = ROOT / "clients/python/stream_drive.py"
BINARY = pathlib.Path(sys.argv.pop(1) if len(sys.argv) > 1 else ROOT / "target/debug/lanemap").resolve()
WITHIN_S = 60
# Where CLIENT drives.
AROUND = (11.59, 48.09, 11.62, 48.11)


def free_port():
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return held.getsockname()[1]


class SharedMap(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))
        self.url = f"http://127.0.0.1:{free_port()}"
        self.start()
        self.addCleanup(lambda: self.end(signal.SIGTERM))

    def start(self):
        command = [BINARY, "serve", "--listen", self.url.removeprefix("http://"), "--data-dir", self.folder / "data"]
        self.server = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        self.assertTrue(re.search(r"http://", self.server.stdout.readline()))

    def end(self, with_signal):
        self.server.send_signal(with_signal)
        self.server.stdout.close()
        self.server.wait(WITHIN_S)

    def drive(self):
        done = subprocess.run([sys.executable, CLIENT, self.url], cwd=self.folder, text=True, capture_output=True, timeout=WITHIN_S)
        self.assertEqual(done.returncode, 0, done.stderr)

    def settled(self, map, least_km):
        """Waits until all that was driven is in the map."""
        until = time.monotonic() + WITHIN_S
        while time.monotonic() < until:
            cells = map.cells(AROUND)
            if sum(cell.line_km for cell in cells) >= least_km and not any(cell.dirty for cell in cells):
                return cells
            time.sleep(0.05)
        self.fail(f"the map is {cells}")

    def test_curves_and_features_are_the_lines_that_were_driven(self):
        with lanemap.Map(self.url) as map:
            self.drive()
            # The bend leads over the border of two cells.
            cells = self.settled(map, 0.25)
            self.assertEqual(len(cells), 2)
            curves = map.splines(bbox=AROUND)
            features = list(map.features(bbox=AROUND, page=1))
            self.assertEqual(len(curves), sum(cell.lanes for cell in cells))
            named = {feature.id: feature for feature in features}
            self.assertEqual(set(named), {f"{curve.cell}.{curve.id}.{curve.part}" for curve in curves})
            self.assertAlmostEqual(sum(curve.length_m for curve in curves) / 1e3, sum(cell.line_km for cell in cells), delta=0.01)
            for cell in cells:
                z, x, y = map_tile(cell.id)
                of_cell = sorted(curve.id for curve in map.cell(cell.id))
                self.assertEqual(sorted(curve.id for curve in map.splines(z, x, y) if curve.cell == cell.id), of_cell)
            for curve in curves:
                feature = named[f"{curve.cell}.{curve.id}.{curve.part}"]
                samples = curve.sample(step_m=0.25)
                self.assertTrue(np.all((samples.existence > 0) & (samples.existence <= 1)))
                self.assertTrue(np.all((samples.lateral_sigma_m > 0) & (samples.lateral_sigma_m < 1)))
                scale = np.array([np.cos(np.radians(48.1)) * 111_320, 111_200])
                places = (feature.coordinates[:, None, :2] - samples.wgs84[None, :, :2]) * scale
                # A vertex of the drawn line lies on the curve, and samples of it no farther than half a step.
                self.assertLess(np.linalg.norm(places, axis=2).min(axis=1).max(), 0.125 + 0.03)
            self.assertEqual(list(map.features(bbox=(0, 0, 1, 1))), [])

    def test_a_watch_goes_on_over_a_kill_of_the_server_and_misses_no_version(self):
        with lanemap.Map(self.url) as map:
            told, came = [], threading.Condition()

            def follow():
                with map.watch(since=0) as watch:
                    for news in watch:
                        with came:
                            if isinstance(news, lanemap.Change):
                                told.append(news)
                            came.notify()

            def versions():
                return {change.cell: change.to_version for change in told}

            threading.Thread(target=follow, daemon=True).start()
            self.drive()
            with came:
                self.assertTrue(came.wait_for(lambda: told, WITHIN_S))
            self.end(signal.SIGKILL)
            self.start()
            self.drive()
            now = {cell.id: cell.version for cell in self.settled(map, 0.25)}
            with came:
                self.assertTrue(came.wait_for(lambda: versions() == now, WITHIN_S), (told, now))
        # Of each cell, from each version to the next one, without a gap, across the kill.
        at = {}
        for change in told:
            self.assertEqual(change.from_version, at.get(change.cell, 0), told)
            at[change.cell] = change.to_version

    def test_a_collection_or_cell_that_is_not_there_is_said(self):
        with lanemap.Map(self.url) as map:
            for call in (lambda: list(map.features("roads")), lambda: map.cell("14-1-1")):
                with self.assertRaises(lanemap.MapError) as raised:
                    call()
                self.assertEqual(raised.exception.status, 404)
            with self.assertRaises(lanemap.MapError) as raised:
                next(map.watch(since=1_000_000))
            self.assertEqual(raised.exception.status, 400)


def map_tile(cell):
    return tuple(int(number) for number in cell.split("-"))


if __name__ == "__main__":
    unittest.main(verbosity=2)
