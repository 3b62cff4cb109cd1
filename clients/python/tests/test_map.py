"""A reader of the map goes on whatever its network does: it asks again, keeps what has not changed, and misses no change."""

import json
import threading
import time
import unittest
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import lanemap
import numpy as np
from lanemap import _curves
from lanemap.v1 import shared_map_pb2


class Service:
    """A server that answers what a test says, one answer after the other; the last one stays."""

    def __init__(self, test, *answers):
        self.requests, self.answers = [], list(answers)
        service = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self):
                service.requests.append((self.path, {name.lower(): value for name, value in self.headers.items()}))
                status, headers, body = service.answers.pop(0) if len(service.answers) > 1 else service.answers[0]
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                if headers.get("Content-Type") == "text/event-stream":
                    self.close_connection = True
                    self.send_header("Connection", "close")
                else:
                    self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_):
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        test.addCleanup(server.server_close)
        test.addCleanup(server.shutdown)
        self.url = f"http://127.0.0.1:{server.server_port}"


def answer(body, status=200, **headers):
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return status, named, body if isinstance(body, bytes) else json.dumps(body).encode()


def events(*blocks):
    return 200, {"Content-Type": "text/event-stream"}, "".join(f"{block}\n\n" for block in ("retry: 1", *blocks)).encode()


def cell_event(position, revision, before, after):
    data = dict(revision=revision, cell="14-1-2", from_version=before, to_version=after, lines_upserted=1, lines_removed=0)
    return f"event: cell\nid: {position}\ndata: {json.dumps(data)}"


def event_feature(kind, **more):
    known = dict(
        kind=kind, cell="14-1-2", revision=5, version=3, told_at="2026-01-01T00:00:00Z", withdrawn=False, lane="a",
        category="white_solid", probability=0.98, noticed="2025-12-31T00:00:00Z", drives=7, **more,
    )
    geometry = {"type": "LineString", "coordinates": [[11.0, 48.0, 500.0], [11.1, 48.1, 501.0]]}
    return {"type": "Feature", "id": "14-1-2.event.1", "properties": known, "geometry": geometry}


def happened(kind):
    return f"event: change\ndata: {json.dumps(event_feature(kind))}"


def feature(number):
    geometry = {"type": "LineString", "coordinates": [[11.0, 48.0, 500.0], [11.1, 48.1, 501.0]]}
    return {"type": "Feature", "id": str(number), "properties": {"drives": number}, "geometry": geometry}


class Reading(unittest.TestCase):
    def test_features_are_read_page_by_page_as_they_are_taken(self):
        first = {"features": [feature(1)], "links": [{"rel": "next", "href": "/collections/lanes/items?after=1"}]}
        service = Service(self, answer(first), answer({"features": [feature(2)], "links": []}))
        with lanemap.Map(service.url) as map:
            features = map.features(bbox=(11, 48, 12, 49), page=1, category="white_solid")
            self.assertEqual(next(features).id, "1")
            self.assertEqual([path for path, _ in service.requests], ["/collections/lanes/items?bbox=11.0,48.0,12.0,49.0&limit=1&category=white_solid"])
            self.assertEqual([(one.id, one.coordinates.shape) for one in features], [("2", (2, 3))])
        self.assertEqual(service.requests[1][0], "/collections/lanes/items?after=1")

    def test_a_link_to_another_host_is_not_followed_for_it_would_be_told_the_token(self):
        page = {"features": [], "links": [{"rel": "next", "href": "http://elsewhere.invalid/items"}]}
        service = Service(self, answer(page))
        with self.assertRaisesRegex(lanemap.MapError, "links to another host"):
            list(lanemap.Map(service.url, token="secret").features())
        self.assertEqual(service.requests[0][1]["authorization"], "Bearer secret")

    def test_what_has_not_changed_does_not_travel_again(self):
        cells = {"cells": [], "links": []}
        service = Service(self, answer(cells, ETag='"7"'), answer(b"", 304, ETag='"7"'))
        map = lanemap.Map(service.url)
        self.assertEqual((map.cells(), map.cells()), ([], []))
        self.assertEqual([headers.get("if-none-match") for _, headers in service.requests], [None, '"7"'])

    def test_no_more_answers_are_kept_than_there_is_room_for(self):
        map = lanemap.Map("http://localhost", cache_bytes=10)
        for number in range(4):
            map._http._keep(str(number), "tag", b"1234")
        map._http._keep("large", "tag", b"12345678901")
        self.assertEqual((list(map._http._kept), map._http._kept_bytes), (["2", "3"], 8))

    def test_a_busy_service_is_asked_again_when_it_says_so(self):
        service = Service(self, answer({}, 503, Retry_After="1"), answer({"cells": [], "links": []}))
        started = time.monotonic()
        self.assertEqual(lanemap.Map(service.url).cells(), [])
        self.assertGreater(time.monotonic() - started, 0.9)

    def test_a_refusal_says_what_the_service_says(self):
        service = Service(self, answer({"title": "Malformed query parameter", "detail": "parameter bbox"}, 400))
        with self.assertRaises(lanemap.MapError) as raised:
            list(lanemap.Map(service.url).features())
        self.assertEqual((raised.exception.status, raised.exception.title), (400, "Malformed query parameter"))
        self.assertIn("parameter bbox", str(raised.exception))

    def test_a_service_that_is_not_there_is_said(self):
        with self.assertRaises(lanemap.MapUnreachable):
            lanemap.Map("http://127.0.0.1:1", retries=0).cells()

    def test_bad_input_is_refused_with_its_limit(self):
        map = lanemap.Map("http://localhost")
        for call, words in [
            (lambda: lanemap.Map("localhost:8080"), "url is 'localhost:8080'"),
            (lambda: lanemap.Map("http://localhost", token="x", credentials=lanemap.Credentials()), "at most one"),
            (lambda: map.cells(bbox=(1, 2, 3)), "4 finite numbers"),
            (lambda: map.watch(bbox=(1, 2, 3, float("nan"))), "4 or 6 finite numbers"),
            (lambda: map.splines(14, 3), "z, x and y, or a bbox"),
            (lambda: map.splines(14, 3, 4, bbox=(1, 2, 3, 4)), "one of them"),
        ]:
            with self.assertRaisesRegex(ValueError, words):
                call()


class Watching(unittest.TestCase):
    def test_changes_come_in_order_and_the_position_follows_them(self):
        service = Service(self, events('event: start\nid: 3\ndata: {"revision":3}', cell_event("3-5-4", 4, 1, 2), cell_event("5", 5, 7, 9)))
        with lanemap.Map(service.url).watch(since=3, cells=["14-1-2"]) as watch:
            change = next(watch)
            self.assertEqual((change.cell, change.from_version, change.to_version, watch.position), ("14-1-2", 1, 2, "3"))
            self.assertEqual((next(watch).revision, watch.position), (5, "3-5-4"))
        self.assertEqual(service.requests[0][0], "/changes?since=3&cell=14-1-2")

    def test_what_happened_is_told_typed_and_the_position_waits_for_the_change_that_tells_of_it(self):
        service = Service(self, events(cell_event("4", 4, 1, 2), happened("vanished"), cell_event("5", 5, 2, 3)))
        with lanemap.Map(service.url).watch() as watch:
            self.assertEqual(next(watch).to_version, 2)
            event = next(watch)
            self.assertIsInstance(event, lanemap.MapEvent)
            self.assertEqual((event.kind, event.probability, event.category), ("vanished", 0.98, lanemap.Category.WHITE_SOLID))
            self.assertEqual((event.coordinates.shape, event.into, event.moved_m, watch.position), ((2, 3), (), None, "4"))
            self.assertEqual(next(watch).to_version, 3)

    def test_events_and_the_history_of_a_line_are_read(self):
        renamed = dict(kind="renamed", version=3, at="2026-01-01T00:00:00Z")
        history = dict(
            cell="14-1-2", lane="b", versions=[], events=[event_feature("moved", moved_m=0.7), event_feature("repainted", category_before="white_dashed")],
            came_from=[dict(renamed, lane="a")], became=[dict(renamed, kind="split", lanes=["b", "c"])],
        )
        service = Service(self, answer({"features": [event_feature("renamed", into=["b"])], "more": False}), answer(history))
        map = lanemap.Map(service.url)
        (event,) = map.events(bbox=(1, 2, 3, 4), kinds=["renamed", "split"], limit=7)
        self.assertEqual((event.into, event.withdrawn), (("b",), False))
        read = map.history("14-1-2", "b")
        self.assertEqual((read.came_from[0].lanes, read.became[0].lanes, read.events[0].moved_m), (("a",), ("b", "c"), 0.7))
        self.assertEqual([event.category_before for event in read.events], [None, lanemap.Category.WHITE_DASHED])
        paths = [path for path, _ in service.requests]
        self.assertEqual(paths[1], "/cells/14-1-2/lanes/b/history")
        self.assertIn("kind=renamed", paths[0])

    def test_a_stream_that_breaks_is_gone_on_with_after_the_last_event_that_was_taken(self):
        service = Service(self, events(cell_event("4", 4, 1, 2)), answer({}, 503, Retry_After="0"), events(cell_event("6", 6, 2, 3)))
        with lanemap.Map(service.url).watch() as watch:
            self.assertEqual([next(watch).to_version, next(watch).to_version], [2, 3])
        self.assertEqual([headers.get("last-event-id") for _, headers in service.requests[:3]], [None, "4", "4"])

    def test_a_sign_of_life_moves_the_position_and_a_reset_is_told(self):
        service = Service(self, events(": alive\nid: 9", 'event: reset\nid: 12\ndata: {"revision":12,"oldest":10}', ": alive\nid: 13"), events(cell_event("14", 14, 0, 1)))
        with lanemap.Map(service.url).watch(since=1) as watch:
            self.assertEqual(next(watch), lanemap.Reset(12))
            self.assertEqual(next(watch).revision, 14)
        self.assertEqual(service.requests[1][1]["last-event-id"], "13")

    def test_a_refusal_ends_it(self):
        service = Service(self, answer({"title": "Unauthenticated", "detail": "who asks?"}, 401))
        with self.assertRaises(lanemap.MapError) as raised:
            next(lanemap.Map(service.url).watch())
        self.assertEqual(raised.exception.status, 401)


class Curves(unittest.TestCase):
    def curve(self, points_mm):
        steps = np.diff(np.vstack([[0, 0, 0], points_mm]), axis=0)
        count = len(points_mm)
        lane = shared_map_pb2.FusedLane(
            id="a", category=2, category_posterior_permille=[0, 0, 950], xyz_mm=[int(step) for step in steps.ravel()],
            lateral_sigma_mm=range(100, 100 + count), height_sigma_mm=[200] * count, existence_permille=[900] * count, drives=3,
        )
        cell = shared_map_pb2.CellMap(cell="14-8718-5685", lanes=[lane])
        cell.anchor.latitude_deg, cell.anchor.longitude_deg, cell.anchor.height_m = 48.1374, 11.5755, 0.0
        (curve,) = _curves.curves_of(cell)
        return curve

    def test_a_straight_line_is_sampled_evenly_from_end_to_end(self):
        curve = self.curve([[0, 0, 0], [3000, 0, 0], [9000, 0, 0], [12000, 0, 0]])
        samples = curve.sample(step_m=2.0)
        self.assertAlmostEqual(curve.length_m, 12.0, places=9)
        np.testing.assert_allclose(samples.enu[:, 0], np.arange(0, 12.1, 2), atol=1e-3)
        np.testing.assert_allclose(samples.lateral_sigma_m[[0, -1]], [0.1, 0.103])
        self.assertEqual((curve.category, curve.category_probability), (lanemap.Category.WHITE_SOLID, 0.95))

    def test_a_circle_through_control_points_3_m_apart_is_a_circle_to_a_millimetre(self):
        angles = np.arange(0, 1.5, 3 / 50)
        curve = self.curve(np.round(50_000 * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])).astype(int))
        samples = curve.sample(0.1)
        inner = samples.enu[40:-40]
        np.testing.assert_allclose(np.linalg.norm(inner, axis=1), 50.0, atol=2e-3)
        np.testing.assert_allclose(np.linalg.norm(np.diff(samples.enu, axis=0), axis=1), samples.arc_m[1], rtol=2e-3)

    def test_places_on_the_earth_are_those_of_the_ellipsoid(self):
        anchor = _curves.Anchor(0.0, 0.0, 0.0)
        place = anchor.wgs84(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 100.0], [111_319.4907932, 0.0, 0.0]]))
        np.testing.assert_allclose(place[:2], [[0, 0, 0], [0, 0, 100]], atol=1e-9)
        self.assertAlmostEqual(place[2, 0], np.degrees(np.arctan2(111_319.4907932, _curves.SEMI_MAJOR_M)), places=12)
        munich = _curves.Anchor(48.1374, 11.5755, 519.0)
        np.testing.assert_allclose(munich.wgs84(np.zeros((1, 3)))[0], [11.5755, 48.1374, 519.0], atol=1e-8)

    def test_a_step_that_is_none_is_refused(self):
        curve = self.curve([[0, 0, 0], [3000, 0, 0]])
        for step in (0, -1, float("nan"), float("inf")):
            with self.assertRaisesRegex(ValueError, "step_m"):
                curve.sample(step)


if __name__ == "__main__":
    unittest.main()
