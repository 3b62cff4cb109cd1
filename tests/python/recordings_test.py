"""Recordings as others see them: python recordings_test.py path/to/lanemap

MCAP files that lanemap writes are read by the `mcap` library of their makers, message by message, with nothing but the
schemas in the file. Bags that `rosbags` writes, each chunk compressed by bz2 or lz4, are replayed by lanemap.
"""
import json
import math
import pathlib
import struct
import subprocess
import sys
import tempfile

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

LANES = {
    "openlane_bag/msg/LanePoint": "float32 x\nfloat32 y\nfloat32 z\nfloat32 visibility\n",
    "openlane_bag/msg/Lane": "LanePoint[] lane\nint32 num_points\nint32 attribute\nint32 track_id\nint32 category\n",
    "openlane_bag/msg/LaneList": "Header header\nLane[] lane_list\nint32 num_lanes\n",
}


def lanemap(*arguments):
    done = subprocess.run([sys.argv[1], *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def only_segment(drives):
    (segment,) = sorted(drives.glob("segment-*"))
    return segment


def test_every_message_of_a_recording_decodes_by_the_schemas_in_the_file(folder, drives):
    recording = folder / "drive.mcap"
    lanemap("record", "--drives", drives, "--output", recording, "--origin", "45.06,7.67")
    segment = only_segment(drives)
    times = [int(file.stem) * 10 for file in sorted(segment.glob("*.json"))]
    with recording.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 0
        assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
        found = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(schema.name, []).append((message.log_time, channel.topic, decoded))
    assert sum(map(len, found.values())) == summary.statistics.message_count

    ((_, _, start),) = found["lanemap.v1.SessionStart"]
    assert start.drive_id == segment.name and start.sensor.axis_convention == 1
    frames = found["lanemap.v1.Frame"]
    assert [time for time, _, _ in frames] == times == [frame.time_unix_ns for _, _, frame in frames]
    assert [frame.sequence for _, _, frame in frames] == list(range(1, len(frames) + 1))
    assert sum(len(line.xyz) for _, _, frame in frames for line in frame.detections) > 1000
    scenes, poses = found["foxglove.SceneUpdate"], found["foxglove.FrameTransform"]
    assert len(scenes) == len(poses) == len(frames)
    for (_, _, frame), (_, _, scene), (_, _, pose) in zip(frames, scenes, poses):
        lines = scene.entities[0].lines
        assert [3 * len(line.points) for line in lines] == [len(line.xyz) for line in frame.detections]
        place = frame.odometry.odometry_from_vehicle.position
        assert (pose.translation.x, pose.translation.y) == (place.x, place.y)
    assert len(found["foxglove.LocationFix"]) >= 1


def pose_of(annotation):
    """Position and quaternion (x, y, z, w) of the camera in the world."""
    product = [[sum(annotation["pose"][i][k] * annotation["extrinsic"][k][j] for k in range(4)) for j in range(4)] for i in range(3)]
    m = [row[:3] for row in product]
    w = math.sqrt(max(0.0, 1 + m[0][0] + m[1][1] + m[2][2])) / 2
    x = math.copysign(math.sqrt(max(0.0, 1 + m[0][0] - m[1][1] - m[2][2])) / 2, m[2][1] - m[1][2])
    y = math.copysign(math.sqrt(max(0.0, 1 - m[0][0] + m[1][1] - m[2][2])) / 2, m[0][2] - m[2][0])
    z = math.copysign(math.sqrt(max(0.0, 1 - m[0][0] - m[1][1] + m[2][2])) / 2, m[1][0] - m[0][1])
    return [row[3] for row in product], (x, y, z, w)


def camera_points(lane, extrinsic):
    """OpenLane's ground frame to the camera, as the authors' bag writer brings its predictions there."""
    for gx, gy, gz in lane["xyz"]:
        v = (gy, -gx, gz - extrinsic[2][3])
        yield [sum(extrinsic[k][i] * v[k] for k in range(3)) for i in range(3)]


def write_bag(path, drives, compression):
    store = get_typestore(Stores.ROS1_NOETIC)
    types = {}
    for name, text in LANES.items():
        types.update(get_types_from_msg(text.replace("Header ", "std_msgs/Header "), name))
    store.register(types)
    kinds = store.types
    segment = only_segment(drives)
    bag = Writer(path)
    if compression:
        bag.set_compression(compression)
    with bag:
        poses = bag.add_connection("/gt_pose_wc", "geometry_msgs/msg/PoseStamped", typestore=store)
        lanes = bag.add_connection("/lanes_predict", "openlane_bag/msg/LaneList", typestore=store)
        for file in sorted(segment.glob("*.json")):
            annotation = json.loads(file.read_text())
            result = json.loads((drives / "results" / segment.name / file.name).read_text())
            time = int(file.stem) * 10
            stamp = kinds["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
            header = kinds["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="map")
            (x, y, z), (qx, qy, qz, qw) = pose_of(annotation)
            pose = kinds["geometry_msgs/msg/Pose"](
                position=kinds["geometry_msgs/msg/Point"](x=x, y=y, z=z),
                orientation=kinds["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
            )
            message = kinds["geometry_msgs/msg/PoseStamped"](header=header, pose=pose)
            bag.write(poses, time, store.serialize_ros1(message, message.__msgtype__))
            listed = []
            for number, lane in enumerate(result["lane_lines"]):
                point = kinds["openlane_bag/msg/LanePoint"]
                points = [point(x=a, y=b, z=c, visibility=1.0) for a, b, c in camera_points(lane, annotation["extrinsic"])]
                listed.append(kinds["openlane_bag/msg/Lane"](
                    lane=points, num_points=len(points), attribute=0, track_id=number, category=lane["category"]))
            message = kinds["openlane_bag/msg/LaneList"](header=header, lane_list=listed, num_lanes=len(listed))
            bag.write(lanes, time, store.serialize_ros1(message, message.__msgtype__))


def lines_of(results):
    return [json.loads(file.read_text())["lane_lines"] for file in sorted(results.rglob("*.json"))]


def test_bags_of_rosbags_give_the_local_maps_of_the_folder(folder, drives):
    segment = only_segment(drives)
    expected = folder / "expected"
    lanemap("replay", "--local", "--drives", drives, "--results-dir", expected)
    expected = lines_of(expected)
    assert sum(map(len, expected)) > 50
    for compression in (None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4):
        bags = folder / f"bags-{compression}"
        bags.mkdir()
        write_bag(bags / f"{segment.name}.bag", drives, compression)
        results = folder / f"results-{compression}"
        report = lanemap("replay", "--local", "--json", "--drives", bags, "--bag-camera", drives, "--results-dir", results)
        assert json.loads(report)["frames"] == len(expected)
        replayed = lines_of(results)
        assert len(replayed) == len(expected)
        for lines, wanted in zip(replayed, expected):
            assert [line["track_id"] for line in lines] == [line["track_id"] for line in wanted]
            for line, want in zip(lines, wanted):
                assert len(line["xyz"]) == len(want["xyz"])
                assert all(math.dist(a, b) < 2e-3 for a, b in zip(line["xyz"], want["xyz"])), compression


def main():
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        drives = folder / "drives"
        lanemap("simulate", "--out", drives, "--drives", "1", "--length-km", "0.3", "--roads", "long-road", "--seed", "12")
        test_every_message_of_a_recording_decodes_by_the_schemas_in_the_file(folder, drives)
        test_bags_of_rosbags_give_the_local_maps_of_the_folder(folder, drives)
    print("recordings: every message decodes by its embedded schema; bags of rosbags (none, bz2, lz4) replay")


if __name__ == "__main__":
    main()
