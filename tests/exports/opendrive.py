"""Reads OpenDRIVE: as the standard says, with CARLA, and with ASAM's checker."""
import json
import math
import pathlib
import subprocess
import sys

import numpy as np
import shapely
from lxml import etree

STEP_M = 0.25


def numbers(element, *names):
    return [float(element.get(name)) for name in names]


def cubic(pieces, s):
    """The value of the last piece that begins at or before a way."""
    start, a, b, c, d = next((piece for piece in reversed(pieces) if piece[0] <= s + 1e-9), pieces[0])
    ds = s - start
    return a + b * ds + c * ds**2 + d * ds**3


def reference(road):
    """Function of the way: place, heading; and the ways at which geometries begin. Their ends meet."""
    geometries = []
    for geometry in road.find("planView"):
        s, x, y, heading, length = numbers(geometry, "s", "x", "y", "hdg", "length")
        (poly,) = geometry
        assert poly.tag == "paramPoly3" and poly.get("pRange") == "normalized"
        geometries.append((s, x, y, heading, length, numbers(poly, *(k + axis for axis in "UV" for k in "abcd"))))

    def at(s):
        start, x, y, heading, length, (au, bu, cu, du, av, bv, cv, dv) = next(
            (g for g in reversed(geometries) if g[0] <= s + 1e-9), geometries[0]
        )
        p = (s - start) / length
        u, v = au + bu * p + cu * p**2 + du * p**3, av + bv * p + cv * p**2 + dv * p**3
        turn = math.atan2(bv + 2 * cv * p + 3 * dv * p**2, bu + 2 * cu * p + 3 * du * p**2)
        cos, sin = math.cos(heading), math.sin(heading)
        return np.array([x + u * cos - v * sin, y + u * sin + v * cos]), heading + turn

    for before, after in zip(geometries, geometries[1:]):
        assert abs(before[0] + before[4] - after[0]) < 1e-9, "ways do not meet"
        end, _ = at(after[0] - 2e-9)
        assert np.hypot(*(end - after[1:3])) < 1e-3, "geometries do not meet"
    length = geometries[-1][0] + geometries[-1][4]
    assert abs(length - float(road.get("length"))) < 1e-6
    return at, length, [g[0] for g in geometries]


def ascending(elements, way):
    pieces = [numbers(element, way, "a", "b", "c", "d") for element in elements] or [[0.0] * 5]
    assert all(a[0] < b[0] for a, b in zip(pieces, pieces[1:]))
    return pieces


def sampled(path):
    """The plane, reference lines and borders of lanes as polylines, and a check of the heights of references."""
    document = etree.parse(str(path))
    plane = document.findtext("header/geoReference")
    references, borders = [], []
    for road in document.iterfind("road[@junction='-1']"):
        at, length, _ = reference(road)
        heights = ascending(road.find("elevationProfile"), "s")
        offsets = ascending(road.iterfind("lanes/laneOffset"), "s")
        ways = np.append(np.arange(0.0, length, STEP_M), length)
        line = [[*at(s)[0], cubic(heights, s)] for s in ways]
        references.append(np.array(line))
        sections = list(road.iterfind("lanes/laneSection"))
        starts = [float(section.get("s")) for section in sections] + [length]
        assert all(a < b for a, b in zip(starts, starts[1:]))
        for section, start, end in zip(sections, starts, starts[1:]):
            inner = np.append(np.arange(start, end - 1e-6, STEP_M), end - 1e-6)
            lanes = {int(lane.get("id")): ascending(lane.iterfind("width"), "sOffset") for lane in section.iter("lane")}
            ids = sorted(lanes)
            assert ids == list(range(ids[0], ids[-1] + 1)) and 0 in lanes
            for side in (1, -1):
                t = np.array([cubic(offsets, s) for s in inner])
                for lane in [0, *(id_ for id_ in sorted(ids, key=abs) if id_ * side > 0)]:
                    if lane:
                        width = np.array([cubic(lanes[lane], s - start) for s in inner])
                        assert width.min() > -0.01, (road.get("id"), lane, width.min())
                        t = t + side * width
                    places = [(at(s), offset) for s, offset in zip(inner, t)]
                    border = [
                        [place[0] - offset * math.sin(heading), place[1] + offset * math.cos(heading), np.nan]
                        for (place, heading), offset in places
                    ]
                    if len(border) > 1:
                        borders.append(np.array(border))

    def height_errors(served):
        tree = shapely.STRtree([shapely.LineString(line) for line in served])
        worst = 0.0
        for line in references:
            for point in line:
                here = shapely.Point(point[:2])
                # Of lines that cross here, the one at this height.
                near = [tree.geometries[index] for index in tree.query(here, "dwithin", 0.02)]
                errors = [abs(on.interpolate(on.project(here)).z - point[2]) for on in near]
                worst = max(worst, min(errors, default=0.0))
        return worst

    return plane, references, borders, height_errors


def lane_end(road, contact, lane):
    """Both borders of a lane at an end of its road, the one nearer to lane 0 first; the height, and the road's heading."""
    at, length, _ = reference(road)
    s = 0.0 if contact == "start" else length
    place, heading = at(s)
    sections = road.findall("lanes/laneSection")
    section = sections[0 if contact == "start" else -1]
    within = s - float(section.get("s"))
    t = cubic(ascending(road.iterfind("lanes/laneOffset"), "s"), s)
    side = 1 if lane > 0 else -1
    for number in range(side, lane + side, side):
        before = t
        width = section.find(f".//lane[@id='{number}']").iterfind("width")
        t = t + side * cubic(ascending(width, "sOffset"), within)
    normal = np.array([-math.sin(heading), math.cos(heading)])
    return place + before * normal, place + t * normal, cubic(ascending(road.find("elevationProfile"), "s"), s), heading


def junctions_join(path):
    """Number of junctions, and of ways over them. Each way begins and ends where the lanes do that it joins, in their direction."""
    document = etree.parse(str(path))
    roads = {road.get("id"): road for road in document.iterfind("road")}
    ways = 0
    for junction in document.iterfind("junction"):
        for connection in junction.iterfind("connection"):
            connecting, incoming = roads[connection.get("connectingRoad")], roads[connection.get("incomingRoad")]
            assert connecting.get("junction") == junction.get("id")
            link = connection.find("laneLink")
            own = connecting.find(f".//lane[@id='{link.get('to')}']")
            assert own.find("link/predecessor").get("id") == link.get("from")
            for end, name in [("start", "predecessor"), ("end", "successor")]:
                of = connecting.find(f"link/{name}")
                assert name == "successor" or roads[of.get("elementId")] is incoming
                lane = int(own.find(f"link/{name}").get("id"))
                beyond = roads[of.get("elementId")]
                joint = beyond.find("link/" + ("predecessor" if of.get("contactPoint") == "start" else "successor"))
                assert joint.get("elementType") == "junction" and joint.get("elementId") == junction.get("id")
                here, there = lane_end(connecting, end, int(link.get("to"))), lane_end(beyond, of.get("contactPoint"), lane)
                assert max(np.hypot(*(here[0] - there[0])), np.hypot(*(here[1] - there[1]))) < 0.02, (connecting.get("id"), end)
                assert abs(here[2] - there[2]) < 0.01
                # Which way the lane is driven there, by the rule of the road.
                along = (lane < 0) == (beyond.get("rule") == "RHT")
                assert along == ((of.get("contactPoint") == "end") == (end == "start"))
                assert math.cos(here[3] - there[3]) * (1 if along else -1) > 0.99
            ways += 1
    return len(document.findall("junction")), ways


def routes_of_carla(path, drives, apart_m):
    """Along how many of the ways of some drives CARLA finds lanes that lead on, of those that begin and end on lanes."""
    program = '''
import carla, json, sys
m = carla.Map("map", open(sys.argv[1]).read())
led = asked = 0
def lane_at(x, y):
    found = m.get_waypoint(carla.Location(x, -y, 0))
    place = found.transform.location
    return found if ((place.x - x) ** 2 + (place.y + y) ** 2) ** 0.5 < 1.2 else None
for here, there in json.load(sys.stdin):
    start, end = lane_at(*here), lane_at(*there)
    if start is None or end is None or start.is_junction or end.is_junction:
        continue
    asked += 1
    frontier, found = [start], False
    for _ in range(60):
        found = any(((p.transform.location.x - there[0]) ** 2 + (p.transform.location.y + there[1]) ** 2) ** 0.5 < 2.0 for p in frontier)
        if found or not frontier:
            break
        frontier = [after for p in frontier for after in p.next(2.0)][:64]
    led += found
print(led, asked)
'''
    pairs = []
    for places in drives:
        ways = np.append(0.0, np.cumsum(np.hypot(*np.diff(places, axis=0).T)))
        for way in np.arange(0.0, ways[-1] - apart_m, 15.0):
            pairs.append([places[np.searchsorted(ways, at)].tolist() for at in (way, way + apart_m)])
    done = subprocess.run([sys.executable, "-c", program, path], input=json.dumps(pairs), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return map(int, done.stdout.split())


def read_with_carla(path):
    """Number of places on lanes that CARLA finds; each lies where a lane is, and leads on to others."""
    # In a process of its own: it ends the process where it cannot read a file.
    program = (
        "import carla, sys; m = carla.Map('map', open(sys.argv[1]).read());"
        "w = m.generate_waypoints(2.0); assert all(1.5 < p.lane_width < 6.0 for p in w);"
        "assert sum(len(p.next(1.0)) > 0 for p in w) > 0.9 * len(w); print(len(w))"
    )
    done = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 100
    return int(done.stdout)


def read_with_asam_checker(path):
    """The checker of ASAM: its schema and its rules. Lanes may jump where one line ends and another goes on beside it."""
    result = pathlib.Path(path).with_suffix(".xqar")
    config = pathlib.Path(path).with_suffix(".xml")
    config.write_text(
        f'<Config><Param name="InputFile" value="{path}"/><CheckerBundle application="xodrBundle">'
        f'<Param name="resultFile" value="{result}"/></CheckerBundle></Config>'
    )
    done = subprocess.run(
        [sys.executable, "-m", "qc_opendrive.main", "-c", config], capture_output=True, text=True, cwd=config.parent
    )
    assert done.returncode == 0, done.stderr
    report = etree.parse(str(result))
    checkers = {checker.get("checkerId"): checker for checker in report.iter("Checker")}
    run = [name for name, checker in checkers.items() if checker.get("status") == "completed"]
    rules = [issue.get("ruleUID") for issue in report.iter("Issue")]
    assert len(run) > 10 and "check_asam_xodr_xml_valid_schema" in run, run
    jumps = [rule for rule in rules if rule.endswith("lane_smoothness.contact_point_no_horizontal_gaps")]
    assert len(rules) == len(jumps), sorted(set(rules) - set(jumps))
    return len(jumps)
