"""Python client of lanemap: stream what a vehicle's camera sees, hear where the vehicle is.

    import lanemap

    camera = lanemap.Sensor(lanemap.Pose(1.5, 0, 1.6), axes="vehicle")
    with lanemap.Session("http://localhost:8080", fleet="f", vehicle="v", drive="d", sensor=camera, spool="spool") as s:
        s.send(time_ns, pose, [lane_points])  # (n, 3) arrays, metres

A session outlives its connection, and with a spool its process: what is not acked is sent again.
"""

from ._events import Feed, Gap, LocalMap, Refusal, Summary, VehiclePose
from ._link import Credentials
from ._session import Reconnect, Session
from ._spool import SpoolOptions, SpoolRecovery
from ._values import Category, Detection, FieldOfView, GnssFix, Limits, Occlusion, Pose, Sensor
from .errors import LanemapError, Refused, SessionError, SpoolError, SpoolFull

__all__ = [
    "Category",
    "Credentials",
    "Detection",
    "Feed",
    "FieldOfView",
    "Gap",
    "GnssFix",
    "LanemapError",
    "Limits",
    "LocalMap",
    "Occlusion",
    "Pose",
    "Reconnect",
    "Refusal",
    "Refused",
    "Sensor",
    "Session",
    "SessionError",
    "SpoolError",
    "SpoolFull",
    "SpoolOptions",
    "SpoolRecovery",
    "Summary",
    "VehiclePose",
]
