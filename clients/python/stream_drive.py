"""Streams one drive to lanemap: python stream_drive.py http://localhost:8080"""
import sys, time
import numpy as np
import lanemap

def measure(n, radius=300.0):  # put your sensors here: this vehicle follows a bend to the left at 10 m/s between two lines
    turn, ahead = n / radius, np.arange(5, 50, 3) / radius
    lines = [np.column_stack([r * np.sin(ahead), radius - r * np.cos(ahead), 0 * ahead]) for r in (radius + 1.75, radius - 1.75)]
    east, north = radius * np.sin(turn), radius * (1 - np.cos(turn))
    fix = lanemap.GnssFix(48.1 + np.degrees(north / 6.37e6), 11.6 + np.degrees(east / 4.27e6), yaw_enu_rad=turn)
    return lanemap.Pose.planar(east, north, turn), [lanemap.Detection(line, "white_solid") for line in lines], fix

start_ns = time.time_ns()
camera = lanemap.Sensor(lanemap.Pose(1.5, 0, 1.6), axes="vehicle")
with lanemap.Session(sys.argv[1], fleet="docs", vehicle="car-1", drive=str(start_ns), sensor=camera, spool="target/spool") as session:
    for n in range(1, 201):  # 20 s at 10 Hz
        pose, lines, fix = measure(n)
        session.send(start_ns + n * 100_000_000, pose, lines, gnss=fix)
    print(f"{session.finish()} of session {session.id}")
