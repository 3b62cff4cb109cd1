"""What there is to ask of a town's server: python town.py URL settled|kept|anew.

`settled` fails until all that drives said is in the map. `kept` prints the addresses of some hundred tiles of zoom 14 to 18,
`anew` those of every tile of zoom 16 to 20 that has lines, in a random order that is always the same; it asks for one coarse tile
of each cell, so that cells are read from the store before tiles are counted.
"""

import json
import math
import random
import sys
import urllib.request


def get(url):
    with urllib.request.urlopen(url) as answer:
        return json.load(answer)


def tile(place, zoom):
    y = 0.5 - math.asinh(math.tan(math.radians(place[1]))) / (2 * math.pi)
    return zoom, int((place[0] / 360 + 0.5) * 2**zoom), int(y * 2**zoom)


def main(url, what):
    cells = get(f"{url}/cells")
    line_km = sum(cell["line_km"] for cell in cells["cells"])
    if what == "settled":
        sys.exit(0 if cells["settled"] else 1)
    places = []
    for cell in cells["cells"]:
        if what == "anew":
            urllib.request.urlopen(f"{url}/tiles/lanes/{cell['id'].replace('-', '/')}").close()
        for feature in get(f"{url}/cells/{cell['id']}/lanes.geojson")["features"]:
            coordinates = feature["geometry"]["coordinates"]
            places += coordinates if feature["geometry"]["type"] == "LineString" else sum(coordinates, [])
    zooms = range(14, 19) if what == "kept" else range(16, 21)
    tiles = sorted({tile(place, zoom) for zoom in zooms for place in places})
    random.Random(1).shuffle(tiles)
    for z, x, y in tiles[: 500 if what == "kept" else None]:
        print(f"/tiles/lanes/{z}/{x}/{y}")
    print(f"{line_km:.0f} km of lines in {len(cells['cells'])} cells", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
