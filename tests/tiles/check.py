"""Tiles as Python and GDAL read them: python check.py URL FOLDER, after check.mjs has left the tiles in FOLDER.

PyPI mapbox-vector-tile reads the same vertices as @mapbox/vector-tile; each lies within half a unit of the line that the
server gives as GeoJSON, but for the centimetre to which that is written; GDAL counts the same features.
"""

import json
import math
import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import mapbox_vector_tile

EXTENT = 4096
# GeoJSON has 7 decimals (up to 8 mm off) and chords 4 mm off; the ends of a line are rounded in both axes.
GEOJSON_M = 0.012


def get(url):
    with urllib.request.urlopen(url) as answer:
        return json.load(answer)


def units(place, zoom):
    longitude, latitude = place[:2]
    y = 0.5 - math.asinh(math.tan(math.radians(latitude))) / (2 * math.pi)
    return (longitude / 360 + 0.5) * 2**zoom * EXTENT, y * 2**zoom * EXTENT


def distance(point, line):
    nearest = math.inf
    for (x0, y0), (x1, y1) in zip(line, line[1:]):
        dx, dy = x1 - x0, y1 - y0
        square = dx * dx + dy * dy
        along = 0 if square == 0 else max(0, min(1, ((point[0] - x0) * dx + (point[1] - y0) * dy) / square))
        nearest = min(nearest, math.hypot(point[0] - x0 - along * dx, point[1] - y0 - along * dy))
    return nearest


def main(url, folder):
    lines = {}
    for cell in get(f"{url}/cells")["cells"]:
        for feature in get(f"{url}/cells/{cell['id']}/lanes.geojson")["features"]:
            lines[feature["id"]] = feature["geometry"]["coordinates"]
    read = json.loads((folder / "lines.json").read_text())
    checked = 0
    for name, layers in read.items():
        zoom, x, y = map(int, name.split("/"))
        tile = mapbox_vector_tile.decode((folder / f"{name}.mvt").read_bytes(), default_options={"y_coord_down": True})
        assert set(tile) == set(layers), name
        for layer, parts in layers.items():
            found = []
            for feature in tile[layer]["features"]:
                geometry = feature["geometry"]
                found.append([geometry["coordinates"]] if geometry["type"] == "LineString" else geometry["coordinates"])
            assert found == parts, f"{name} {layer}"
        if zoom < 14:
            continue
        unit_m = 40_075_016.7 * math.cos(math.atan(math.sinh(math.pi * (1 - 2 * (y + 0.5) / 2**zoom)))) / 2**zoom / EXTENT
        limit = 0.51 + GEOJSON_M / unit_m
        named = [(feature["properties"], parts) for layer in ("lanes", "dashes") if layer in layers
                 for feature, parts in zip(tile[layer]["features"], layers[layer])]
        for properties, parts in named:
            line = [units(place, zoom) for place in lines[f"{properties['cell']}.{properties['lane']}.{properties['part']}"]]
            for part in parts:
                for index, vertex in enumerate(part):
                    at = (x * EXTENT + vertex[0], y * EXTENT + vertex[1])
                    # An end, of the line or where the tile cuts it, is rounded in both axes.
                    most = limit * math.sqrt(2) if index in (0, len(part) - 1) else limit
                    assert distance(at, line) <= most, f"{name}: vertex {index} of {len(part)}, {distance(at, line)} units off"
                    checked += 1
        report = subprocess.run(["ogrinfo", "-al", "-so", folder / f"{name}.mvt"], check=True, capture_output=True, text=True).stdout
        counts = dict(re.findall(r"Layer name: (\w+)[\s\S]*?Feature Count: (\d+)", report))
        assert counts == {layer: str(len(parts)) for layer, parts in layers.items()}, f"{name}: {counts}"
    print(f"{len(read)} tiles decode with mapbox-vector-tile and GDAL; {checked} vertices lie on their lines")


if __name__ == "__main__":
    main(sys.argv[1].rstrip("/"), Path(sys.argv[2]))
