"""Reads Lanelet2 maps with the library of their makers, and asks its routing graph."""
import json

import lanelet2
import numpy as np
import pyproj
from lanelet2.projection import LocalCartesianProjector, UtmProjector
from lxml import etree

#: A route of a drive is asked for between places this many frames apart.
FRAMES_APART = 40


class Lanelets:
    def __init__(self, path, origin):
        place = lanelet2.io.Origin(*origin, 0)
        self.map, errors = lanelet2.io.loadRobust(str(path), LocalCartesianProjector(place))
        assert not errors, errors[:3]
        _, errors = lanelet2.io.loadRobust(str(path), UtmProjector(place))
        assert not errors, errors[:3]
        self.document = etree.parse(str(path))
        (comment,) = self.document.xpath("//comment()")
        self.plane = comment.text.split("local_x, local_y:")[1].strip()
        local = {
            node.get("id"): [float(node.find(f"tag[@k='{key}']").get("v")) for key in ("local_x", "local_y", "ele")]
            for node in self.document.iterfind("node")
        }
        self.lines = [np.array([local[nd.get("ref")] for nd in way.iterfind("nd")]) for way in self.document.iterfind("way")]
        rules = lanelet2.traffic_rules.create(
            lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
        )
        self.graph = lanelet2.routing.RoutingGraph(self.map, rules)
        assert not self.graph.checkValidity(False)

    def coordinates_agree(self):
        """Latitude and longitude say the same as local_x and local_y."""
        to_plane = pyproj.Transformer.from_crs("EPSG:4326", self.plane, always_xy=True)
        for node in self.document.iterfind("node"):
            x, y = to_plane.transform(float(node.get("lon")), float(node.get("lat")))
            tags = {tag.get("k"): float(tag.get("v")) for tag in node.iterfind("tag")}
            assert max(abs(x - tags["local_x"]), abs(y - tags["local_y"])) < 2e-4
            assert int(node.get("id")) > 0

    def bounds_do_not_cross(self):
        """No lanelet is turned over, empty, or wider than a lane."""
        for lanelet in self.map.laneletLayer:
            ring = np.array([(p.x, p.y) for p in lanelet.polygon2d()])
            x, y = ring.T
            area = 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
            length = lanelet2.geometry.length2d(lanelet)
            # Left bound, then the right one backwards: clockwise.
            assert area < 0, lanelet.id
            assert 1.0 < -area / length < 6.0, (lanelet.id, area, length)
            left, right = map(lanelet2.geometry.to2D, (lanelet.leftBound, lanelet.rightBound))
            assert not lanelet2.geometry.intersects2d(left, right), lanelet.id

    def at(self, x, y, toward):
        """The lanelet around a place that is driven in a direction; None where there is none."""
        point = lanelet2.core.BasicPoint2d(x, y)
        for distance, lanelet in lanelet2.geometry.findNearest(self.map.laneletLayer, point, 4):
            if distance > 0.3:
                continue
            line = np.array([(p.x, p.y) for p in lanelet.centerline])
            near = max(0, int(np.argmin(np.hypot(*(line - [x, y]).T))) - 1)
            if np.dot(line[near + 1] - line[near], toward) > 0:
                return lanelet
        return None

    def follow_the_drives(self, folder, least_lanes, least_share, least_beside, leads_back):
        """Where a vehicle went, a route leads along lanelets that are driven its way, and none back but round a block."""
        asked = led = beside = 0
        for segment in sorted(folder.glob("segment-*")):
            poses = [json.loads(path.read_text())["pose"] for path in sorted(segment.glob("*.json"))]
            places = np.array([[pose[0][3], pose[1][3]] for pose in poses])
            # From the first places where the map has lanes on to the last.
            for index in range(FRAMES_APART, len(places) - 2 * FRAMES_APART, FRAMES_APART):
                here, there = places[index], places[index + FRAMES_APART]
                start = self.at(*here, places[index + 1] - here)
                end = self.at(*there, places[index + FRAMES_APART + 1] - there)
                asked += 1
                if start is None or end is None:
                    continue
                led += self.graph.getRoute(start, end) is not None
                side_by_side = {each.id for each in (start, *self.graph.lefts(start), *self.graph.rights(start))}
                if end.id not in side_by_side and not leads_back:
                    assert self.graph.getRoute(end, start) is None
                beside += 1 + len(self.graph.lefts(start)) + len(self.graph.rights(start)) >= least_lanes or (
                    1 + len(self.graph.adjacentLefts(start)) + len(self.graph.adjacentRights(start)) >= least_lanes
                )
        assert asked > 5 and led >= least_share * asked, f"{led} routes of {asked}"
        assert beside >= least_beside * asked, f"{beside} of {asked} have a lane beside them"
        print(f"  {led} routes of {asked}, {beside} with a lane beside them")

    def have_side_by_side(self, lanes):
        """Somewhere so many lanelets lie side by side, each to be reached from the next."""
        most = max(1 + len(self.graph.lefts(each)) + len(self.graph.rights(each)) for each in self.map.laneletLayer)
        assert most == lanes, most


def lanelets_of(path, origin):
    return Lanelets(path, origin)
