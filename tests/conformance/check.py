"""The map as OGC API - Features, read by others: python tests/conformance/check.py target/debug/lanemap NODE_MODULES

A server with the fused map of a small simulated town:

* GDAL's OAPIF driver reads every collection, and counts for 200 random boxes what shapely counts in all that is served;
* schemathesis finds nothing over /api;
* geojsonhint has nothing against any GeoJSON;
* abstract tests of OGC 17-069r4, Annex A: landing page (A.2.2), API definition (A.2.3), conformance (A.2.4), collections
  (A.2.5, A.2.6), features with bbox, limit, datetime and unknown parameters (A.2.7), single features (A.2.8), GeoJSON (A.4).
"""

import concurrent.futures
import json
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request

from shapely.geometry import box, shape
from shapely.strtree import STRtree

HERE = pathlib.Path(__file__).resolve().parent
COLLECTIONS = ["lanes", "control_points", "cells", "drives"]
ORIGIN = "45.06,7.67"
BOXES = 200
PATIENCE_S = 120
SCHEMATHESIS_S = int(os.environ.get("SCHEMATHESIS_S", "45"))


def fetch(url, accept="*/*"):
    request = urllib.request.Request(url, headers={"Accept": accept})
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as refused:
        return refused.code, refused.headers, refused.read()


def get(url):
    status, _, body = fetch(url)
    assert status == 200, f"{url}: {status} {body[:300]}"
    return json.loads(body)


def link(document, rel):
    return next((link["href"] for link in document["links"] if link["rel"] == rel), None)


def pages(url):
    while url:
        page = get(url)
        assert page["numberReturned"] == len(page["features"]), url
        yield page
        url = link(page, "next")


class Server:
    """A server with the map of a town."""

    def __init__(self, lanemap, folder):
        town = folder / "town"
        run = lambda *arguments: subprocess.run([lanemap, *arguments], check=True, capture_output=True, text=True)
        run("simulate", "--out", town, "--roads", "city", "--drives", "6", "--length-km", "0.8", "--seed", "1")
        command = [lanemap, "serve", "--listen", "127.0.0.1:0", "--data-dir", folder / "store"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.url = re.search(r"http://\S+?:\d+", self.process.stdout.readline()).group(0)
        run("replay", "--drives", town, "--origin", ORIGIN, "--server", self.url)
        deadline = time.monotonic() + PATIENCE_S
        # Asked as often as a reader would: there is no answer that waits.
        while not ((cells := get(f"{self.url}/cells"))["settled"] and cells["total"] >= 4):
            assert time.monotonic() < deadline, f"the map settles: {cells}"
            time.sleep(0.2)

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(60) == 0, "the server stops cleanly"


def random_boxes(features):
    """Boxes of all sizes around what is there, and some where nothing is."""
    generator = random.Random(7)
    bounds = [shape(feature["geometry"]).bounds for feature in features]
    west, south = min(b[0] for b in bounds), min(b[1] for b in bounds)
    east, north = max(b[2] for b in bounds), max(b[3] for b in bounds)
    for _ in range(BOXES):
        size = 10 ** generator.uniform(-3, 0.2)
        width, height = size * (east - west), size * (north - south)
        x = generator.uniform(west - 0.3 * width, east)
        y = generator.uniform(south - 0.3 * height, north)
        decimals = generator.choice([5, 7, 9])
        yield [round(value, decimals) for value in (x, y, x + width, y + height)]


def gdal_count(url, collection, bounds):
    command = ["ogrinfo", "-ro", "-so", "-spat", *map(str, bounds), f"OAPIF:{url}", collection]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert not done.stderr.strip(), done.stderr
    return int(re.search(r"Feature Count: (\d+)", done.stdout).group(1))


def counts(url, all_features):
    trees = {name: STRtree([shape(feature["geometry"]) for feature in features]) for name, features in all_features.items()}
    jobs = []
    for number, bounds in enumerate(random_boxes(all_features["cells"] + all_features["lanes"])):
        area = box(*bounds)
        expected = {name: len(tree.query(area, predicate="intersects")) for name, tree in trees.items()}
        for name in COLLECTIONS:
            query = urllib.parse.urlencode({"bbox": ",".join(map(str, bounds)), "limit": 10000})
            page = get(f"{url}/collections/{name}/items?{query}")
            found = page.get("numberMatched", page["numberReturned"])
            assert found == expected[name], f"{name} {bounds}: {found} are served, and {expected[name]} are there"
        name = COLLECTIONS[number % len(COLLECTIONS)]
        jobs.append((name, bounds, expected[name]))
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        read = list(pool.map(lambda job: gdal_count(url, job[0], job[1]), jobs))
    for (name, bounds, expected), found in zip(jobs, read):
        assert found == expected, f"GDAL counts {found} {name} in {bounds}, and {expected} are there"
    some = sum(expected > 0 for _, _, expected in jobs)
    assert some > BOXES / 3, f"only {some} boxes have anything in them"
    print(f"{len(jobs)} boxes: GDAL and the server count what shapely counts ({some} with features)")


def gdal_reads_all(url, all_features, folder):
    for name, features in all_features.items():
        out = folder / f"{name}.geojson"
        command = ["ogr2ogr", "-f", "GeoJSON", out, f"OAPIF:{url}", name]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        assert not done.stderr.strip(), done.stderr
        told = subprocess.run(["ogrinfo", "-ro", "-so", out, name], check=True, capture_output=True, text=True).stdout
        assert f"Feature Count: {len(features)}\n" in told, told
        filtered = subprocess.run(
            ["ogrinfo", "-ro", "-so", "-where", "drives = 1", f"OAPIF:{url}", name], capture_output=True, text=True
        )
        if name != "drives":
            ones = sum(feature["properties"]["drives"] == 1 for feature in features)
            assert f"Feature Count: {ones}\n" in filtered.stdout, filtered.stdout
        print(f"GDAL converts {len(features)} {name}")


def hints(url, all_features, folder, node_modules):
    served = folder / "geojson"
    served.mkdir()
    addresses = []
    for name in COLLECTIONS:
        addresses += [f"{url}/collections/{name}/items?limit=10000", f"{url}/collections/{name}/items?limit=7"]
        addresses += [f"{url}/collections/{name}/items/{feature['id']}" for feature in all_features[name][:5]]
    for cell in get(f"{url}/cells")["cells"]:
        addresses += [f"{url}/cells/{cell['id']}/lanes.geojson", f"{url}/exports/{cell['id']}.geojson"]
    for session in get(f"{url}/sessions")["sessions"]:
        links = [link["href"] for link in session["links"] if link["type"] == "application/geo+json"]
        addresses += [href for href in links if "crs=local" not in href]
    addresses += [f"{url}/sessions/live", f"{url}/differences?since=1"]
    files = []
    for number, address in enumerate(addresses):
        status, headers, body = fetch(address)
        assert status == 200 and headers["Content-Type"] == "application/geo+json", f"{address}: {status}"
        decimals = re.findall(rb"\d+\.(\d+)", body)
        document = json.loads(body)
        assert "crs" not in document, address
        coordinates = json.dumps([f.get("geometry") for f in document.get("features", [document])])
        assert all(len(d) <= 7 for d in re.findall(r"\d+\.(\d+)", coordinates)), f"{address} has more than 7 decimals"
        file = served / f"{number}.geojson"
        file.write_bytes(body)
        files.append((address, file))
    script = """
      const {hint} = require("@mapbox/geojsonhint"), fs = require("fs");
      for (const file of process.argv.slice(1)) {
        // Places are written to 7 decimals, 1 cm: that 6 would do is no error, and not so for lane lines.
        for (const found of hint(fs.readFileSync(file, "utf8"), {precisionWarning: false})) {
          console.log(file, JSON.stringify(found)); process.exitCode = 1;
        }
      }"""
    environment = {**os.environ, "NODE_PATH": str(node_modules)}
    done = subprocess.run(["node", "-e", script, *(str(file) for _, file in files)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[:3000] + done.stderr
    print(f"geojsonhint has nothing against {len(files)} documents")


def abstract_tests(url, all_features):
    landing = get(url)
    for rel in ["service-desc", "service-doc", "conformance", "data"]:
        assert link(landing, rel), rel
    status, headers, body = fetch(link(landing, "service-desc"), "application/vnd.oai.openapi+json;version=3.0")
    assert status == 200 and headers["Content-Type"] == "application/vnd.oai.openapi+json;version=3.0"
    api = json.loads(body)
    classes = get(link(landing, "conformance"))["conformsTo"]
    for name in ["core", "oas30", "geojson"]:
        assert f"http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{name}" in classes
    listed = get(link(landing, "data"))["collections"]
    assert [collection["id"] for collection in listed] == COLLECTIONS
    for collection in listed:
        name = collection["id"]
        assert get(f"{url}/collections/{name}") == collection
        west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
        outside = [f["id"] for f in all_features[name] if not box(west, south, east, north).buffer(1e-9).covers(shape(f["geometry"]))]
        assert name == "drives" or not outside, f"{name}: {outside[:3]} lie outside of the extent"
        items = link(collection, "items")
        parameters = {p["name"]: p for p in api["paths"][urllib.parse.urlsplit(items).path]["get"]["parameters"]}
        assert parameters["bbox"]["schema"]["type"] == "array" and not parameters["bbox"]["explode"]
        assert parameters["limit"]["schema"]["minimum"] == 1 and parameters["datetime"]["schema"]["type"] == "string"
        for wrong in ["no=1", "limit=0", "limit=x", "bbox=1,2,3", "bbox=0,10,10,0", "datetime=x", "limit=1&limit=1"]:
            status, headers, _ = fetch(f"{items}?{wrong}")
            assert (status, headers["Content-Type"]) == (400, "application/problem+json"), f"{items}?{wrong}: {status}"
        assert len(get(f"{items}?limit=99999999")["features"]) == min(10000, len(all_features[name]))
        west, south, east, north = collection["extent"]["spatial"]["bbox"][0]
        inside = get(f"{items}?bbox={west},{south},{east},{north}&bbox-crs=http://www.opengis.net/def/crs/OGC/1.3/CRS84")
        assert len(inside["features"]) > 0
        with_heights = get(f"{items}?bbox={west},{south},-1e4,{east},{north},1e4")
        assert len(with_heights["features"]) == len(inside["features"])
        feature = all_features[name][-1]
        single = get(f"{items}/{feature['id']}")
        assert link(single, "self") and link(single, "collection") == link(collection, "self")
        assert fetch(f"{items}/nothing")[0] == 404 and fetch(f"{url}/collections/nothing/items")[0] == 404
    for cell in all_features["cells"]:
        ring = cell["geometry"]["coordinates"][0]
        assert ring[0] == ring[-1] and shape(cell["geometry"]).exterior.is_ccw, cell["id"]
    print("the abstract tests hold")


def schemathesis(url, folder):
    # The changes are a stream, which does not end by itself: tests/tests/changes.rs reads it.
    command = [
        pathlib.Path(sys.executable).with_name("st"), "--config-file", HERE / "schemathesis.toml", "run", f"{url}/api",
        "--url", url, "--exclude-path", "/changes", "--checks", "all", "--max-time", str(SCHEMATHESIS_S), "--workers", "2",
        "--continue-on-failure", "--seed", "1",
    ]
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(HERE), "LANEMAP_URL": url}
    # It leaves files where it runs.
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    print(done.stdout[-1500:] if done.returncode == 0 else done.stdout[-60000:] + done.stderr[-3000:])
    assert done.returncode == 0, "schemathesis found something"


def main(lanemap, node_modules):
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        server = Server(lanemap, folder)
        try:
            all_features = {
                name: [f for page in pages(f"{server.url}/collections/{name}/items?limit=999") for f in page["features"]]
                for name in COLLECTIONS
            }
            for name, features in all_features.items():
                assert len({feature["id"] for feature in features}) == len(features) > 0, name
            abstract_tests(server.url, all_features)
            counts(server.url, all_features)
            gdal_reads_all(server.url, all_features, folder)
            hints(server.url, all_features, folder, node_modules)
            schemathesis(server.url, folder)
        finally:
            server.stop()


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]).resolve(), pathlib.Path(sys.argv[2]).resolve())
