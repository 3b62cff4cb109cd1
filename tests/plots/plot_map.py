#!/usr/bin/env python3
"""Draw a map beside its truth: the whole of it, and close-ups in which a hook, a double line or a shift can be seen.

    python3 -m venv target/venv && target/venv/bin/pip install -r tests/plots/requirements.txt
    target/venv/bin/python tests/plots/plot_map.py --map lanes.geojson --truth maps/segment-X.geojson --output map.png

--map is GeoJSON in the drive's metres: `/sessions/{id}/lanes.geojson?crs=local` of a server, as a file or a URL.
--truth is a drive's ground-truth map. --drive, a folder of OpenLane annotations, adds the vehicle's path, and with
--detections what the detector reported of every frame (its sibling folder `results/`). At least --map or --truth is needed.

Truth is drawn grey and wide, each lane of the map in a colour of its own with a dot where it starts and a cross where it ends.
With both, the share of each that lies within --tolerance metres of the other is printed.
"""
import argparse
import json
import pathlib
import urllib.request

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

COLUMNS = 3


def read_json(source):
    if source.startswith(("http://", "https://")):
        with urllib.request.urlopen(source) as response:
            return json.load(response)
    return json.loads(pathlib.Path(source).read_text())


def lines_of(source):
    """Every line of a GeoJSON document as [n, 3] metres; points without height lie at 0."""
    lines = []
    for feature in read_json(source)["features"]:
        geometry = feature["geometry"]
        parts = {"LineString": lambda c: [c], "MultiLineString": lambda c: c}[geometry["type"]](geometry["coordinates"])
        lines += [np.array([[*point, 0.0][:3] for point in part], float) for part in parts if len(part) > 1]
    return lines


def world_from_camera(annotation):
    return np.array(annotation["pose"]) @ np.array(annotation["extrinsic"])


def path_of(drive):
    frames = sorted(pathlib.Path(drive).glob("*.json"))
    return np.array([np.array(json.loads(frame.read_text())["pose"])[:3, 3] for frame in frames])


def detections_of(drive):
    """Detected points of all frames in the world. Result points lie in the ground frame: x right, y front, z up."""
    drive = pathlib.Path(drive)
    found = [np.empty((0, 3))]
    for frame in sorted(drive.glob("*.json")):
        result = drive.parent / "results" / drive.name / frame.name
        if not result.exists():
            continue
        annotation = json.loads(frame.read_text())
        extrinsic, transform = np.array(annotation["extrinsic"]), world_from_camera(annotation)
        for lane in json.loads(result.read_text())["lane_lines"]:
            ground = np.array(lane["xyz"], float).reshape(-1, 3)
            vehicle_axes = np.stack([ground[:, 1], -ground[:, 0], ground[:, 2] - extrinsic[2, 3]], axis=1)
            camera = vehicle_axes @ extrinsic[:3, :3]
            found.append(camera @ transform[:3, :3].T + transform[:3, 3])
    return np.concatenate(found)


def resample(line, step_m=0.5):
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    stations = np.append(np.arange(0.0, along[-1], step_m), along[-1])
    return np.stack([np.interp(stations, along, line[:, axis]) for axis in range(3)], axis=1)


def share_near(points, others, tolerance_m):
    """Share of the points with one of the others within the tolerance, seen from above."""
    near = [np.linalg.norm(others[:, :2] - point[:2], axis=1).min() <= tolerance_m for point in points]
    return float(np.mean(near))


def close_ups(points, limit):
    """Centres of `limit` windows, evenly spread over the lines along the map's longer axis, in the middle of what is there."""
    longer = int(np.ptp(points[:, 0]) < np.ptp(points[:, 1]))
    stretches = np.array_split(points[np.argsort(points[:, longer])], limit)
    return [(part[:, :2].min(axis=0) + part[:, :2].max(axis=0)) / 2 for part in stretches if len(part)]


def draw(axes, truth, lanes, path, detections, origin):
    if len(detections):
        axes.plot(*(detections[:, :2] - origin).T, ".", color="0.7", markersize=1.5, zorder=0)
    for line in truth:
        axes.plot(*(line[:, :2] - origin).T, color="0.55", linewidth=3.0, alpha=0.6, zorder=1)
    if len(path):
        axes.plot(*(path[:, :2] - origin).T, ":", color="black", linewidth=0.8, zorder=2)
    for number, lane in enumerate(lanes):
        colour, flat = f"C{number % 10}", lane[:, :2] - origin
        axes.plot(*flat.T, color=colour, linewidth=1.1, zorder=3)
        axes.plot(*flat[0], "o", color=colour, markersize=3, zorder=4)
        axes.plot(*flat[-1], "x", color=colour, markersize=4, zorder=4)
    axes.set_aspect("equal")
    axes.grid(True, linewidth=0.3)
    axes.tick_params(labelsize=6)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--map", help="GeoJSON in metres, file or URL")
    parser.add_argument("--truth", help="ground-truth GeoJSON of the drive")
    parser.add_argument("--drive", help="folder of the drive's annotations")
    parser.add_argument("--detections", action="store_true", help="also draw what the detector reported")
    parser.add_argument("--tolerance", type=float, default=0.5, help="metres, for the printed shares (default 0.5)")
    parser.add_argument("--window", type=float, default=50.0, help="side of a close-up, metres (default 50)")
    parser.add_argument("--windows", type=int, default=6, help="number of close-ups (default 6; 0 for none)")
    parser.add_argument("--title", default="")
    parser.add_argument("--output", required=True, help="PNG to write")
    options = parser.parse_args()
    if not (options.map or options.truth):
        parser.error("nothing to draw: give --map, --truth or both")
    if options.detections and not options.drive:
        parser.error("--detections needs --drive")

    truth = lines_of(options.truth) if options.truth else []
    lanes = lines_of(options.map) if options.map else []
    path = path_of(options.drive) if options.drive else np.empty((0, 3))
    detections = detections_of(options.drive) if options.detections else np.empty((0, 3))
    if not truth and not lanes:
        raise SystemExit("no line in " + " or ".join(filter(None, [options.map, options.truth])))

    dense = np.concatenate([resample(line) for line in (lanes or truth)])
    origin = np.round(dense[:, :2].min(axis=0), -1)
    windows = close_ups(dense, options.windows) if options.windows else []
    rows = -(-len(windows) // COLUMNS)
    figure = plt.figure(figsize=(15, 6 + 5 * rows), layout="constrained")
    grid = figure.add_gridspec(1 + rows, COLUMNS, height_ratios=[1.2] + [1.0] * rows)
    draw(figure.add_subplot(grid[0, :]), truth, lanes, path, detections, origin)
    for number, centre in enumerate(windows):
        axes = figure.add_subplot(grid[1 + number // COLUMNS, number % COLUMNS])
        draw(axes, truth, lanes, path, detections, origin)
        axes.set_xlim(*(centre[0] - origin[0] + np.array([-0.5, 0.5]) * options.window))
        axes.set_ylim(*(centre[1] - origin[1] + np.array([-0.5, 0.5]) * options.window))
    name = options.title or pathlib.PurePath((options.truth or options.map).split("?")[0]).stem
    figure.suptitle(f"{name}: {len(lanes)} lanes, {len(truth)} true lines, metres from ({origin[0]:g}, {origin[1]:g})")
    figure.savefig(options.output, dpi=110)

    if truth and lanes:
        true_points = np.concatenate([resample(line) for line in truth])
        true_to_map = share_near(true_points, dense, options.tolerance)
        map_to_truth = share_near(dense, true_points, options.tolerance)
        print(f"within {options.tolerance:g} m: {map_to_truth:.1%} of the map's lines, {true_to_map:.1%} of the true lines")


if __name__ == "__main__":
    main()
