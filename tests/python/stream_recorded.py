"""Streams a recorded drive through the Python client: stream_recorded.py URL DRIVE.pb SPOOL [options].

The drive is a `lanemap.v1.UploadObservationsRequest`. What an earlier run of the same drive has left in the spool is
delivered first, and the drive goes on after the last frame that was taken. With `--pause-after N` it prints `taken N` once
that frame is taken, and waits to be killed. At the end it prints the session's name and a summary.
"""
import argparse
import json
import pathlib
import signal

import lanemap
import numpy as np
from lanemap.v1 import ingest_service_pb2

options = argparse.ArgumentParser()
options.add_argument("url")
options.add_argument("drive", type=pathlib.Path)
options.add_argument("spool", type=pathlib.Path)
options.add_argument("--keep-alive-s", type=float, default=20.0)
options.add_argument("--ca")
options.add_argument("--cert")
options.add_argument("--key")
options.add_argument("--token-file")
options.add_argument("--vehicle")
options.add_argument("--pause-after", type=int)
options = options.parse_args()


def frame_arguments(frame):
    """A frame of the recording as `Session.send` takes it."""
    gnss = frame.gnss
    fix = lanemap.GnssFix(
        gnss.position.latitude_deg,
        gnss.position.longitude_deg,
        gnss.position.height_m,
        gnss.horizontal_sigma_m,
        gnss.vertical_sigma_m,
        gnss.yaw_enu_rad if gnss.HasField("yaw_enu_rad") else None,
    )
    covariance = None
    if frame.odometry.HasField("motion_covariance"):
        covariance = np.zeros((6, 6))
        covariance[np.triu_indices(6)] = frame.odometry.motion_covariance.upper_triangle
        covariance += np.triu(covariance, 1).T
    return dict(
        time_ns=frame.time_unix_ns,
        pose=lanemap.Pose.of(frame.odometry.odometry_from_vehicle),
        detections=[lanemap.Detection(np.reshape(line.xyz, (-1, 3)), line.category) for line in frame.detections],
        gnss=fix if frame.HasField("gnss") else None,
        motion_covariance=covariance,
        sequence=frame.sequence,
    )


recorded = ingest_service_pb2.UploadObservationsRequest.FromString(options.drive.read_bytes())
view = recorded.start.sensor.field_of_view
sensor = lanemap.Sensor(
    lanemap.Pose.of(recorded.start.sensor.vehicle_from_sensor),
    axes="vehicle",
    field_of_view=lanemap.FieldOfView(view.tan_left, view.tan_right, view.tan_up, view.tan_down)
    if recorded.start.sensor.HasField("field_of_view")
    else None,
)
session = lanemap.Session(
    options.url,
    fleet=recorded.start.fleet_id,
    vehicle=options.vehicle or recorded.start.vehicle_id,
    drive=recorded.start.drive_id,
    sensor=sensor,
    spool=lanemap.SpoolOptions(options.spool, max_bytes=4 * 1024 * 1024),
    reconnect=lanemap.Reconnect(longest_pause_s=0.5),
    credentials=lanemap.Credentials(
        ca=options.ca, cert=options.cert, key=options.key, token_file=options.token_file
    ),
    keep_alive_s=options.keep_alive_s,
)
poses = session.poses()
gaps = session.gaps()
with session:
    for frame in recorded.frames:
        if frame.sequence > (session.last_sequence or 0):
            session.send(**frame_arguments(frame))
            if options.pause_after == frame.sequence:
                print("taken", frame.sequence, flush=True)
                signal.pause()
    summary = session.finish()
last_pose = None
for last_pose in poses:
    pass
print(
    json.dumps(
        {
            "session": session.id,
            "acked": summary.acked,
            "refused": summary.refused,
            "reconnections": summary.reconnections,
            "last_pose": last_pose and last_pose.sequence,
            "gaps": [[gap.first, gap.last] for gap in gaps],
        }
    )
)
