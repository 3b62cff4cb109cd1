"""Python client of lanemap: stream what a vehicle's camera sees, hear where the vehicle is; read the map of all vehicles.

    import lanemap

    camera = lanemap.Sensor(lanemap.Pose(1.5, 0, 1.6), axes="vehicle")
    with lanemap.Session("http://localhost:8080", fleet="f", vehicle="v", drive="d", sensor=camera, spool="spool") as s:
        s.send(time_ns, pose, [lane_points])  # (n, 3) arrays, metres

A session outlives its connection, and with a spool its process: what is not acked is sent again.

    for curve in lanemap.Map("http://localhost:8080").splines(bbox=(11.5, 48.1, 11.6, 48.2)):
        print(curve.id, curve.sample(step_m=0.5).wgs84)
"""

from ._curves import Anchor, Curve, Samples
from ._events import Feed, Gap, LocalMap, Refusal, Summary, VehiclePose
from ._link import Credentials
from ._map import Cell, Feature, Map
from ._map_events import Descent, LaneHistory, MapEvent
from ._session import Reconnect, Session
from ._spool import SpoolOptions, SpoolRecovery
from ._values import Category, Detection, FieldOfView, GnssFix, Limits, Occlusion, Pose, Sensor
from ._watch import Change, Reset, Watch
from .errors import LanemapError, MapError, MapUnreachable, Refused, SessionError, SpoolError, SpoolFull

__all__ = [
    "Anchor",
    "Category",
    "Cell",
    "Change",
    "Credentials",
    "Curve",
    "Descent",
    "Detection",
    "Feature",
    "Feed",
    "FieldOfView",
    "Gap",
    "GnssFix",
    "LaneHistory",
    "LanemapError",
    "Limits",
    "LocalMap",
    "Map",
    "MapError",
    "MapEvent",
    "MapUnreachable",
    "Occlusion",
    "Pose",
    "Reconnect",
    "Refusal",
    "Refused",
    "Samples",
    "Sensor",
    "Reset",
    "Session",
    "SessionError",
    "SpoolError",
    "SpoolFull",
    "SpoolOptions",
    "SpoolRecovery",
    "Summary",
    "VehiclePose",
    "Watch",
]
