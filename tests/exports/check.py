"""Exports as others read them: python check.py path/to/lanemap

Three roads are simulated, driven to a server, and exported; GDAL, the libraries of PMTiles, Lanelet2 and CARLA, and ASAM's
own checker of OpenDRIVE read the files. What they read is held against the lines that are served.
"""
import json
import pathlib
import subprocess
import sys
import tempfile
import time
import urllib.request

import numpy as np
import pyproj
import shapely

from opendrive import junctions_join, read_with_asam_checker, read_with_carla, routes_of_carla, sampled
from routing import lanelets_of

#: Roads, each at an origin of its own: what the simulator calls them, and drives along them.
ROADS = {
    "straight": dict(origin=(45.06, 7.67), roads="straight", drives=2),
    "winding": dict(origin=(45.06, 7.72), roads="winding", drives=2),
    "split": dict(origin=(45.06, 7.77), roads="long-road", drives=2),
    "town": dict(origin=(45.06, 7.82), roads="town", drives=4, length_km=0.9),
}
SEVEN_DECIMALS_M = 0.008  # half a unit of the seventh decimal of a degree, in both directions
WITHIN_M = 0.01


def lanemap(*arguments):
    done = subprocess.run([sys.argv[1], *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def fetch(url):
    with urllib.request.urlopen(url) as answer:
        return answer.read()


class Map:
    """A server with the roads on it."""

    def __init__(self, folder):
        self.folder = folder
        self.server = subprocess.Popen(
            [sys.argv[1], "serve", "--listen", "127.0.0.1:0", "--data-dir", folder / "store"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        line = self.server.stdout.readline()
        self.url = next(word.rstrip(",") for word in line.split() if word.startswith("http://"))

    def drive(self):
        for name, road in ROADS.items():
            drives = self.folder / name
            arguments = ["--roads", road["roads"], "--drives", road["drives"], "--length-km", road.get("length_km", 0.4), "--seed", 3]
            lanemap("simulate", "--out", drives, *arguments)
            origin = ",".join(map(str, road["origin"]))
            lanemap("replay", "--drives", drives, "--origin", origin, "--rate", "max", "--server", self.url)
        deadline = time.monotonic() + 60
        while not json.loads(fetch(f"{self.url}/cells"))["settled"]:
            assert time.monotonic() < deadline, "the map does not settle"
            time.sleep(0.05)

    def box(self, name):
        latitude, longitude = ROADS[name]["origin"]
        return f"{longitude - 0.02},{latitude - 0.02},{longitude + 0.02},{latitude + 0.02}"

    def export(self, name, format_, suffix):
        """The file of one road, or of all of them."""
        output = self.folder / f"{name}.{suffix}"
        box = ["--bbox", self.box(name)] if name in ROADS else []
        lanemap("export", "--format", format_, "--server", self.url, *box, "--output", output)
        return output

    def features(self, name):
        query = f"?bbox={self.box(name)}" if name in ROADS else ""
        features, path = [], f"/collections/lanes/items{query}"
        while path:
            page = json.loads(fetch(path if path.startswith("http") else self.url + path))
            features += page["features"]
            path = next((link["href"] for link in page["links"] if link["rel"] == "next"), None)
        return features

    def places(self, name, plane):
        """Where the vehicles were on a road, in metres of a plane: as their receivers say."""
        origin = ROADS[name]["origin"]
        local = pyproj.Proj(proj="ortho", lat_0=origin[0], lon_0=origin[1], ellps="WGS84")
        to_plane = pyproj.Transformer.from_crs("EPSG:4326", plane, always_xy=True)
        for segment in sorted((self.folder / name).glob("segment-*")):
            poses = [json.loads(path.read_text())["pose"] for path in sorted(segment.glob("*.json"))]
            places = np.array([[pose[0][3], pose[1][3]] for pose in poses])
            yield np.column_stack(to_plane.transform(*local(*places.T, inverse=True)))

    def close(self):
        self.server.terminate()
        self.server.wait()


def in_plane(features, plane):
    """Lines of features in metres of a plane."""
    to_plane = pyproj.Transformer.from_crs("EPSG:4979", plane, always_xy=True)
    lines = []
    for feature in features:
        longitude, latitude, height = np.array(feature["geometry"]["coordinates"]).T
        lines.append(np.column_stack([*to_plane.transform(longitude, latitude), height]))
    return lines


def farthest(points, lines):
    """How far the farthest of some points lies from the nearest of some lines, in plan."""
    tree = shapely.STRtree([shapely.LineString(line[:, :2]) for line in lines])
    queries = shapely.points(points[:, :2])
    _, distances = tree.query_nearest(queries, return_distance=True, all_matches=False)
    return float(distances.max())


def close_to_each_other(served, exported, what):
    """Every served vertex lies on an exported line."""
    apart = farthest(np.concatenate(served), exported)
    assert apart <= WITHIN_M, f"{what}: {apart * 1000:.1f} mm"
    return apart


def test_geojson(map_):
    for name in ROADS:
        exported = json.loads(map_.export(name, "geojson", "geojson").read_text())
        assert exported["features"] == map_.features(name) != []


def test_flatgeobuf(map_):
    for name in ROADS:
        path = map_.export(name, "flatgeobuf", "fgb")
        summary = json.loads(subprocess.check_output(["ogr2ogr", "-f", "GeoJSON", "/vsistdout/", path, "-lco", "COORDINATE_PRECISION=7"]))
        served = {feature["id"]: feature for feature in map_.features(name)}
        assert len(summary["features"]) == len(served)
        text = subprocess.check_output(["ogrinfo", "-so", "-al", path], text=True)
        assert f"Feature Count: {len(served)}" in text and '"EPSG",4326' in text and "3D Line String" in text
        for feature in summary["features"]:
            properties = {key: value for key, value in feature["properties"].items() if value is not None}
            original = served[properties.pop("id")]
            assert original["geometry"]["coordinates"] == feature["geometry"]["coordinates"]
            for key, value in original["properties"].items():
                if key in ("first_seen", "last_seen", "confirmed"):
                    # GDAL writes its own form of a time, to milliseconds.
                    assert properties[key].replace("/", "-")[:19].replace(" ", "T") == value[:19], key
                else:
                    assert properties[key] == value, (key, properties[key], value)
            assert properties.keys() == original["properties"].keys()
        # The index: a box around one line finds it.
        longitude, latitude, _ = original["geometry"]["coordinates"][0]
        found = subprocess.check_output(
            ["ogrinfo", "-so", "-al", "-spat", *map(str, [longitude - 1e-6, latitude - 1e-6, longitude + 1e-6, latitude + 1e-6]), path],
            text=True,
        )
        assert 1 <= int(found.split("Feature Count: ")[1].split()[0]) < len(served)


def test_pmtiles(map_):
    import gzip

    import mapbox_vector_tile
    from pmtiles.reader import MmapSource, Reader, all_tiles

    with map_.export("all", "pmtiles", "pmtiles").open("rb") as file:
        source = MmapSource(file)
        reader = Reader(source)
        header, metadata = reader.header(), reader.metadata()
        assert header["clustered"] and (header["min_zoom"], header["max_zoom"]) == (12, 16)
        assert {layer["id"] for layer in metadata["vector_layers"]} >= {"lanes"}
        tiles = list(all_tiles(source))
        assert len(tiles) == header["addressed_tiles_count"] and {z for (z, _, _), _ in tiles} == set(range(12, 17))
        ids = set()
        for (z, x, y), data in tiles:
            tile = gzip.decompress(data)
            decoded = mapbox_vector_tile.decode(tile)
            assert decoded["lanes"]["extent"] == 4096
            ids |= {feature["id"] for feature in decoded["lanes"]["features"]}
            served = fetch(f"{map_.url}/tiles/lanes/{z}/{x}/{y}")
            if served.startswith(b"\x1f\x8b"):
                served = gzip.decompress(served)
            assert tile == served, (z, x, y)
        assert len(ids) == len(map_.features("all"))


def test_lanelet2(map_):
    for name, road in ROADS.items():
        path = map_.export(name, "lanelet2", "osm")
        lanelets = lanelets_of(path, road["origin"])
        served = in_plane(map_.features(name), lanelets.plane)
        apart = close_to_each_other(served, lanelets.lines, f"Lanelet2, {name}")
        lanelets.coordinates_agree()
        lanelets.bounds_do_not_cross()
        print(f"  Lanelet2, {name}: {len(lanelets.map.laneletLayer)} lanelets, {apart * 1000:.1f} mm")
        # Where two drives did not give one line, at the fork and at some crossings, the map has a lane that ends.
        led, beside = {"straight": (1.0, 0.9), "winding": (1.0, 0.6), "split": (0.85, 0.6), "town": (0.85, 0.0)}[name]
        lanelets.follow_the_drives(map_.folder / name, 2, led, beside, leads_back=name == "town")
        if name != "town":
            lanelets.have_side_by_side({"straight": 2, "winding": 2, "split": 4}[name])


def test_opendrive(map_):
    for name in ROADS:
        path = map_.export(name, "opendrive", "xodr")
        plane, references, borders, heights = sampled(path)
        served = in_plane(map_.features(name), plane)
        apart = close_to_each_other(served, references + borders, f"OpenDRIVE, {name}")
        assert farthest(np.concatenate(references), served) <= WITHIN_M
        assert heights(served) <= WITHIN_M
        waypoints = read_with_carla(path)
        print(f"  OpenDRIVE, {name}: {len(references)} roads, {apart * 1000:.1f} mm, {waypoints} waypoints of CARLA")
        junctions, ways = junctions_join(path)
        led, asked = routes_of_carla(path, map_.places(name, plane), 60.0)
        print(f"  {junctions} junctions with {ways} ways; {led} routes of {asked}")
        if name == "town":
            assert junctions >= 4 and led >= 0.8 * asked > 20
        read_with_asam_checker(path)


def main():
    with tempfile.TemporaryDirectory() as folder:
        map_ = Map(pathlib.Path(folder))
        try:
            map_.drive()
            for test in [test_geojson, test_flatgeobuf, test_pmtiles, test_lanelet2, test_opendrive]:
                started = time.monotonic()
                test(map_)
                print(f"{test.__name__}: {time.monotonic() - started:.1f} s")
        finally:
            map_.close()


if __name__ == "__main__":
    main()
