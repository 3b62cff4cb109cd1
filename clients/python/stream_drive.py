"""Streams one drive to lanemap: python stream_drive.py HOST:PORT (message types made from proto/ by grpc_tools)."""
import sys, time
from math import cos, degrees, sin
import grpc
from lanemap.v1 import geometry_pb2 as geo, ingest_service_pb2 as ingest, ingest_service_pb2_grpc as rpc, observation_pb2 as obs

def pose(x, y, z, yaw):
    return geo.Pose(position=geo.Point(x=x, y=y, z=z), rotation=geo.Quaternion(z=sin(yaw / 2), w=cos(yaw / 2)))

def measure(n, radius=300.0):  # put your sensors here: this vehicle follows a bend to the left at 10 m/s between two lines
    turn, lines = n / radius, []
    east, north = radius * sin(turn), radius * (1 - cos(turn))
    for r in (radius + 1.75, radius - 1.75):
        xyz = [c for s in range(5, 50, 3) for c in (r * sin(s / radius), radius - r * cos(s / radius), 0.0)]
        lines.append(obs.Detection(category=obs.LANE_CATEGORY_WHITE_SOLID, xyz=xyz))
    place = geo.GeodeticPosition(latitude_deg=48.1 + degrees(north / 6.37e6), longitude_deg=11.6 + degrees(east / 4.27e6))
    return lines, pose(east, north, 0, turn), obs.GnssFix(position=place, horizontal_sigma_m=1, vertical_sigma_m=2, yaw_enu_rad=turn)

def drive(start_ns=time.time_ns()):
    camera = obs.Sensor(vehicle_from_sensor=pose(1.5, 0, 1.6, 0), axis_convention=obs.AXIS_CONVENTION_VEHICLE)
    yield dict(start=ingest.SessionStart(fleet_id="docs", vehicle_id="car-1", drive_id=str(start_ns), sensor=camera))
    for n in range(1, 201):  # 20 s at 10 Hz
        lines, odometry, fix = measure(n)
        frame = obs.Frame(sequence=n, time_unix_ns=start_ns + n * 100_000_000, gnss=fix, detections=lines)
        frame.odometry.odometry_from_vehicle.CopyFrom(odometry)
        yield dict(frame=frame)
    yield dict(end=ingest.SessionEnd())

requests = (ingest.StreamObservationsRequest(**message) for message in drive())
for response in rpc.IngestServiceStub(grpc.insecure_channel(sys.argv[1])).StreamObservations(requests):
    if response.WhichOneof("message") in ("accepted", "refusal", "ended"):
        print(response)
