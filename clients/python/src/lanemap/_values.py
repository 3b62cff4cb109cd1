"""What a vehicle measures, checked before it is sent: a `ValueError` names field, value and limit."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from .v1 import geometry_pb2, ingest_service_pb2, observation_pb2

Array: TypeAlias = npt.NDArray[np.float64]
Axes: TypeAlias = Literal["vehicle", "sensor_forward_left_up", "sensor_right_down_forward", "openlane_ground"]
Preset: TypeAlias = Literal["default", "paper"]

MAX_ID_CHARS = 128
MAX_MOUNT_M = 100.0
MAX_ODOMETRY_M = 1e7
MAX_VARIANCE = 1e4
MAX_OCCLUSIONS = 64
ROTATION_NORM_TOLERANCE = 1e-3
MIN_POINTS = 2


class Category(IntEnum):
    """What a lane line is painted as; the numbers are OpenLane's codes."""

    UNKNOWN = 0
    WHITE_DASHED = 1
    WHITE_SOLID = 2
    DOUBLE_WHITE_DASHED = 3
    DOUBLE_WHITE_SOLID = 4
    WHITE_LEFT_DASHED_RIGHT_SOLID = 5
    WHITE_LEFT_SOLID_RIGHT_DASHED = 6
    YELLOW_DASHED = 7
    YELLOW_SOLID = 8
    DOUBLE_YELLOW_DASHED = 9
    DOUBLE_YELLOW_SOLID = 10
    YELLOW_LEFT_DASHED_RIGHT_SOLID = 11
    YELLOW_LEFT_SOLID_RIGHT_DASHED = 12
    LEFT_CURB = 20
    RIGHT_CURB = 21


@dataclass(frozen=True)
class Limits:
    """What a service takes; these are its defaults until it has said otherwise."""

    max_detections: int = 64
    max_points_per_detection: int = 4096
    max_point_range_m: float = 500.0
    max_message_bytes: int = 32 * 1024 * 1024
    max_frames_in_flight: int = 64

    @classmethod
    def of(cls, message: ingest_service_pb2.IngestLimits) -> Limits:
        """The limits that a service has named."""
        return cls(
            message.max_detections,
            message.max_points_per_detection,
            message.max_point_range_m,
            message.max_message_bytes,
            message.max_frames_in_flight,
        )


@dataclass(frozen=True)
class Pose:
    """A rigid transform, named target_from_source by what holds it: position in metres, rotation as a unit quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    qx: float = 0.0
    qy: float = 0.0
    qz: float = 0.0
    qw: float = 1.0

    @classmethod
    def planar(cls, x: float, y: float, yaw_rad: float, z: float = 0.0) -> Pose:
        """At (x, y), turned counter-clockwise about z."""
        return cls(x, y, z, qz=math.sin(yaw_rad / 2), qw=math.cos(yaw_rad / 2))

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> Pose:
        """From a 4x4 matrix."""
        array = _floats(matrix, "pose")
        if array.shape != (4, 4):
            raise ValueError(f"pose has the shape {array.shape}, limit: (4, 4)")
        _finite(array, "pose")
        if not np.allclose(array[3], [0, 0, 0, 1], rtol=0, atol=1e-9):
            raise ValueError(f"pose[3] is {array[3].tolist()}, limit: [0, 0, 0, 1]")
        rotation = array[:3, :3]
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if off > ROTATION_NORM_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ValueError(f"pose[:3, :3] is no rotation: R R^T is off the identity by {off:.3g}, limit: 1e-3, det R > 0")
        x, y, z = (float(value) for value in array[:3, 3])
        return cls(x, y, z, *_quaternion(rotation))

    def matrix(self) -> Array:
        """As a 4x4 matrix."""
        x, y, z, w = self.qx, self.qy, self.qz, self.qw
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), self.x],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), self.y],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), self.z],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )

    def to_message(self, name: str, max_position_m: float) -> geometry_pb2.Pose:
        """As the wire has it."""
        position, rotation = (self.x, self.y, self.z), (self.qx, self.qy, self.qz, self.qw)
        for axis, value in zip("xyz", position):
            _within(value, -max_position_m, max_position_m, f"{name}.{axis}")
        norm = math.sqrt(sum(value * value for value in rotation))
        if not abs(norm - 1) <= ROTATION_NORM_TOLERANCE:
            raise ValueError(f"{name}: its quaternion has the norm {norm}, limit: 1 +- {ROTATION_NORM_TOLERANCE}")
        x, y, z, w = rotation
        return geometry_pb2.Pose(
            position=geometry_pb2.Point(x=self.x, y=self.y, z=self.z),
            rotation=geometry_pb2.Quaternion(x=x, y=y, z=z, w=w),
        )

    @classmethod
    def of(cls, message: geometry_pb2.Pose) -> Pose:
        """From the wire."""
        position, rotation = message.position, message.rotation
        return cls(position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)


@dataclass(frozen=True)
class FieldOfView:
    """Bounds of an image as tangents of the angles from the optical axis: cx / fx, (width - cx) / fx, and so on."""

    tan_left: float
    tan_right: float
    tan_up: float
    tan_down: float


@dataclass(frozen=True)
class Sensor:
    """The camera: its mount in the vehicle frame (x forward along the optical axis, y left, z up), and in which axes
    the points of detections are given. There is no default for the axes: confused frames are the commonest bug."""

    vehicle_from_sensor: Pose
    axes: Axes
    field_of_view: FieldOfView | None = None

    def to_message(self) -> observation_pb2.Sensor:
        """As the wire has it."""
        conventions = {
            "vehicle": observation_pb2.AXIS_CONVENTION_VEHICLE,
            "sensor_forward_left_up": observation_pb2.AXIS_CONVENTION_SENSOR_FORWARD_LEFT_UP,
            "sensor_right_down_forward": observation_pb2.AXIS_CONVENTION_SENSOR_RIGHT_DOWN_FORWARD,
            "openlane_ground": observation_pb2.AXIS_CONVENTION_OPENLANE_GROUND,
        }
        if self.axes not in conventions:
            raise ValueError(f"sensor.axes is {self.axes!r}, limit: one of {', '.join(map(repr, conventions))}")
        message = observation_pb2.Sensor(
            vehicle_from_sensor=self.vehicle_from_sensor.to_message("sensor.vehicle_from_sensor", MAX_MOUNT_M),
            axis_convention=conventions[self.axes],
        )
        if self.field_of_view is not None:
            for name in ("tan_left", "tan_right", "tan_up", "tan_down"):
                value = getattr(self.field_of_view, name)
                if not 0 < value <= 100:
                    raise ValueError(f"sensor.field_of_view.{name} is {value}, limit: above 0, at most 100")
                setattr(message.field_of_view, name, value)
        return message


@dataclass(frozen=True)
class Detection:
    """One lane line: points of shape (n, 3), metres, in the session's axes, in any order."""

    points: npt.ArrayLike
    category: Category | int | str = Category.UNKNOWN

    def to_message(self, name: str, limits: Limits) -> observation_pb2.Detection:
        """As the wire has it."""
        points = _floats(self.points, f"{name}.points")
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"{name}.points has the shape {points.shape}, limit: (n, 3)")
        most = limits.max_points_per_detection
        if not MIN_POINTS <= len(points) <= most:
            raise ValueError(f"{name}.points has {len(points)} points, limit: {MIN_POINTS} to {most}")
        _finite(points, f"{name}.points")
        far = np.abs(points) > limits.max_point_range_m
        if far.any():
            row, axis = np.argwhere(far)[0]
            reach = limits.max_point_range_m
            raise ValueError(f"{name}.points[{row}, {axis}] is {points[row, axis]}, limit: -{reach} to {reach} m")
        return observation_pb2.Detection(category=_category(self.category, name), xyz=points.ravel())


@dataclass(frozen=True)
class GnssFix:
    """A GNSS fix of the vehicle's origin: WGS84 degrees, metres above the ellipsoid, standard deviations in metres,
    and the heading of the vehicle's x axis counter-clockwise from east where the receiver measures it."""

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    horizontal_sigma_m: float = 1.0
    vertical_sigma_m: float = 2.0
    yaw_enu_rad: float | None = None

    def to_message(self) -> observation_pb2.GnssFix:
        """As the wire has it."""
        _within(self.latitude_deg, -90, 90, "gnss.latitude_deg")
        _within(self.longitude_deg, -180, 180, "gnss.longitude_deg")
        _within(self.height_m, -1000, 10000, "gnss.height_m")
        _within(self.horizontal_sigma_m, 1e-3, 1e4, "gnss.horizontal_sigma_m")
        _within(self.vertical_sigma_m, 1e-3, 1e4, "gnss.vertical_sigma_m")
        if self.yaw_enu_rad is not None:
            _within(self.yaw_enu_rad, -7, 7, "gnss.yaw_enu_rad")
        position = geometry_pb2.GeodeticPosition(
            latitude_deg=self.latitude_deg, longitude_deg=self.longitude_deg, height_m=self.height_m
        )
        return observation_pb2.GnssFix(
            position=position,
            horizontal_sigma_m=self.horizontal_sigma_m,
            vertical_sigma_m=self.vertical_sigma_m,
            yaw_enu_rad=self.yaw_enu_rad,
        )


@dataclass(frozen=True)
class Occlusion:
    """What another vehicle hides from the camera: between two bearings (radians counter-clockwise from the vehicle's x
    axis, right border first, seen from below the camera) nothing on the road is visible beyond a range, metres."""

    from_rad: float
    to_rad: float
    range_m: float

    def to_message(self, name: str, limits: Limits) -> observation_pb2.Occlusion:
        """As the wire has it."""
        _within(self.from_rad, -math.pi, math.pi, f"{name}.from_rad")
        _within(self.to_rad, self.from_rad, self.from_rad + 2 * math.pi, f"{name}.to_rad")
        _within(self.range_m, 0, limits.max_point_range_m, f"{name}.range_m")
        return observation_pb2.Occlusion(from_rad=self.from_rad, to_rad=self.to_rad, range_m=self.range_m)


def frame(
    sequence: int,
    time_ns: int,
    pose: Pose | npt.ArrayLike,
    detections: Iterable[Detection | npt.ArrayLike],
    gnss: GnssFix | None,
    motion_covariance: npt.ArrayLike | None,
    limits: Limits,
    occlusions: Iterable[Occlusion] = (),
) -> observation_pb2.Frame:
    """A frame as the wire has it."""
    _whole(sequence, 0, 2**64 - 1, "sequence")
    _whole(time_ns, -(2**63), 2**63 - 1, "time_ns")
    odometry = pose if isinstance(pose, Pose) else Pose.from_matrix(pose)
    message = observation_pb2.Frame(sequence=sequence, time_unix_ns=time_ns)
    message.odometry.odometry_from_vehicle.CopyFrom(odometry.to_message("pose", MAX_ODOMETRY_M))
    if motion_covariance is not None:
        message.odometry.motion_covariance.CopyFrom(_covariance(motion_covariance))
    if gnss is not None:
        message.gnss.CopyFrom(gnss.to_message())
    lines = list(detections)
    if len(lines) > limits.max_detections:
        raise ValueError(f"detections has {len(lines)} entries, limit: {limits.max_detections}")
    for index, line in enumerate(lines):
        line = line if isinstance(line, Detection) else Detection(line)
        message.detections.append(line.to_message(f"detections[{index}]", limits))
    hidden = list(occlusions)
    if len(hidden) > MAX_OCCLUSIONS:
        raise ValueError(f"occlusions has {len(hidden)} entries, limit: {MAX_OCCLUSIONS}")
    for index, occlusion in enumerate(hidden):
        message.occlusions.append(occlusion.to_message(f"occlusions[{index}]", limits))
    if message.ByteSize() > limits.max_message_bytes - 16:
        raise ValueError(f"the frame has {message.ByteSize()} bytes, limit: messages of {limits.max_message_bytes} bytes")
    return message


def start(
    fleet: str, vehicle: str, drive: str, sensor: Sensor, preset: Preset, local_map: bool
) -> ingest_service_pb2.SessionStart:
    """A session's start as the wire has it."""
    for name, value in (("fleet", fleet), ("vehicle", vehicle), ("drive", drive)):
        if not 1 <= len(value) <= MAX_ID_CHARS:
            raise ValueError(f"{name} has {len(value)} characters, limit: 1 to {MAX_ID_CHARS}")
    presets = {
        "default": ingest_service_pb2.MAPPER_PRESET_DEFAULT,
        "paper": ingest_service_pb2.MAPPER_PRESET_PAPER,
    }
    if preset not in presets:
        raise ValueError(f"preset is {preset!r}, limit: one of {', '.join(map(repr, presets))}")
    return ingest_service_pb2.SessionStart(
        fleet_id=fleet,
        vehicle_id=vehicle,
        drive_id=drive,
        preset=presets[preset],
        sensor=sensor.to_message(),
        wants_local_map=local_map,
    )


def covariance_of(message: geometry_pb2.TangentCovariance) -> Array:
    """A 6x6 covariance from the wire's upper triangle."""
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = message.upper_triangle
    return matrix + np.triu(matrix, 1).T


def _covariance(given: npt.ArrayLike) -> geometry_pb2.TangentCovariance:
    name = "motion_covariance"
    matrix = _floats(given, name)
    if matrix.shape != (6, 6):
        raise ValueError(f"{name} has the shape {matrix.shape}, limit: (6, 6), x y z roll pitch yaw")
    _finite(matrix, name)
    scale = float(np.abs(matrix).max())
    if scale > MAX_VARIANCE:
        raise ValueError(f"{name} holds {scale}, limit: -{MAX_VARIANCE} to {MAX_VARIANCE}")
    if float(np.abs(matrix - matrix.T).max()) > 1e-9 * scale:
        raise ValueError(f"{name} is not symmetric, limit: symmetric and positive semi-definite")
    if float(np.linalg.eigvalsh(matrix).min()) < -1e-9 * scale:
        raise ValueError(f"{name} has a negative eigenvalue, limit: symmetric and positive semi-definite")
    return geometry_pb2.TangentCovariance(upper_triangle=matrix[np.triu_indices(6)])


def _category(given: Category | int | str, name: str) -> str:
    """The protocol's name of a category."""
    try:
        category = Category[given.upper()] if isinstance(given, str) else Category(given)
    except (KeyError, ValueError):
        listed = ", ".join(f"{category.name} ({category.value})" for category in Category)
        raise ValueError(f"{name}.category is {given!r}, limit: one of {listed}") from None
    return observation_pb2.LaneCategory.Name(category)


def _floats(given: npt.ArrayLike, name: str) -> Array:
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {type(given).__name__} {given!r:.60}, limit: an array of numbers") from None


def _finite(array: Array, name: str) -> None:
    if not np.isfinite(array).all():
        at = tuple(int(index) for index in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}[{', '.join(map(str, at))}] is {array[at]}, limit: finite")


def _within(value: float, least: float, most: float, name: str) -> None:
    if not least <= value <= most:
        raise ValueError(f"{name} is {value}, limit: {least} to {most}")


def _whole(value: int, least: int, most: int, name: str) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not least <= value <= most:
        raise ValueError(f"{name} is {value!r}, limit: a whole number from {least} to {most}")


def _quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation matrix, by the largest of the four for the sake of precision."""
    trace = float(np.trace(rotation))
    squares = np.array([*(1 + 2 * np.diag(rotation) - trace), 1 + trace])
    largest = int(np.argmax(squares))
    r = rotation
    products = np.array(
        [
            [squares[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
            [r[0, 1] + r[1, 0], squares[1], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], squares[2], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], squares[3]],
        ]
    )[largest]
    x, y, z, w = products / np.linalg.norm(products)
    return float(x), float(y), float(z), float(w)


__all__ = ["Axes", "Category", "Detection", "FieldOfView", "GnssFix", "Limits", "Occlusion", "Pose", "Preset", "Sensor"]
