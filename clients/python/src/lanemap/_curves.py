"""Lines of the map as curves: through which points they go, and how sure the map is of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ._values import Array, Category
from .v1 import geometry_pb2, shared_map_pb2

# WGS84.
SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1 / 298.257_223_563
ECCENTRICITY_2 = FLATTENING * (2 - FLATTENING)
# Chords of a segment by which its length is measured: of 3 m that bend by 10 degrees, to a hundredth of a millimetre.
CHORDS = 32


@dataclass(frozen=True)
class Anchor:
    """Origin of a frame east, north, up, metres."""

    latitude_deg: float
    longitude_deg: float
    height_m: float

    @classmethod
    def of(cls, message: geometry_pb2.GeodeticPosition) -> Anchor:
        return cls(message.latitude_deg, message.longitude_deg, message.height_m)

    @cached_property
    def _ecef_from_enu(self) -> Array:
        """The axes of the frame, as columns."""
        lat, lon = np.radians(self.latitude_deg), np.radians(self.longitude_deg)
        east = [-np.sin(lon), np.cos(lon), 0.0]
        north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
        up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
        return np.column_stack([east, north, up])

    def wgs84(self, enu: Array) -> Array:
        """Longitude and latitude, degrees, and height, metres, of points (n, 3)."""
        lat, lon = np.radians(self.latitude_deg), np.radians(self.longitude_deg)
        normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(lat) ** 2)
        ring = (normal + self.height_m) * np.cos(lat)
        origin = np.array([ring * np.cos(lon), ring * np.sin(lon), (normal * (1 - ECCENTRICITY_2) + self.height_m) * np.sin(lat)])
        x, y, z = (origin + enu @ self._ecef_from_enu.T).T
        across = np.hypot(x, y)
        # The latitude by iteration: each step is 150 times nearer, so that five are exact to a nanometre.
        latitude = np.arctan2(z, across * (1 - ECCENTRICITY_2))
        for _ in range(5):
            normals = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
            latitude = np.arctan2(z + ECCENTRICITY_2 * normals * np.sin(latitude), across)
        normals = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
        height = across * np.cos(latitude) + z * np.sin(latitude) - normals * (1 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
        return np.column_stack([np.degrees(np.arctan2(y, x)), np.degrees(latitude), height])


@dataclass(frozen=True, eq=False)
class Samples:
    """Points along a curve, and what is known at each: arrays of one length."""

    arc_m: Array
    """Distance along the curve from its first point, metres."""
    enu: Array
    """(n, 3), metres east, north, up of the curve's anchor."""
    wgs84: Array
    """(n, 3): longitude and latitude, degrees, and height above the ellipsoid, metres."""
    lateral_sigma_m: Array
    """Standard deviation across the line, metres."""
    height_sigma_m: Array
    """Standard deviation of the height, metres."""
    existence: Array
    """Probability that the line is there, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Curve:
    """One line of one cell of the map."""

    id: str
    """Name of the line: it stays however many drives come."""
    cell: str
    part: int
    """Which piece of the line within the cell."""
    category: Category
    category_probability: float
    drives: int
    """Drives that saw some of it."""
    first_seen_ns: int
    last_seen_ns: int
    anchor: Anchor
    points: Array = field(repr=False)
    """Control points (n, 3), metres east, north, up of the anchor. The curve goes through all of them."""
    lateral_sigma_m: Array = field(repr=False)
    height_sigma_m: Array = field(repr=False)
    existence: Array = field(repr=False)
    _parameters: Array = field(repr=False)
    """At each control point; grows."""
    _tangents: Array = field(repr=False)
    """Derivatives by the parameter at each control point, (n, 3)."""

    def sample(self, step_m: float = 1.0) -> Samples:
        """Points that lie `step_m` apart along the curve, as nearly as it divides; the first and the last are its ends."""
        if not (np.isfinite(step_m) and step_m > 0):
            raise ValueError(f"step_m is {step_m!r}, limit: above 0")
        parameters, arcs = self._measured
        count = max(1, int(np.ceil(arcs[-1] / step_m - 1e-9)))
        arc = np.linspace(0.0, arcs[-1], count + 1)
        at = np.interp(arc, arcs, parameters)
        enu = self._at(at)
        known = (self.lateral_sigma_m, self.height_sigma_m, self.existence)
        lateral, height, existence = (np.interp(at, self._parameters, values) for values in known)
        return Samples(arc, enu, self.anchor.wgs84(enu), lateral, height, existence)

    @property
    def length_m(self) -> float:
        """Length of the curve, metres."""
        return float(self._measured[1][-1])

    @cached_property
    def _measured(self) -> tuple[Array, Array]:
        """Parameters close by each other, and the distance along the curve at each."""
        fractions = np.arange(CHORDS) / CHORDS
        starts, widths = self._parameters[:-1, None], np.diff(self._parameters)[:, None]
        parameters = np.append((starts + widths * fractions).ravel(), self._parameters[-1])
        chords = np.linalg.norm(np.diff(self._at(parameters), axis=0), axis=1)
        return parameters, np.concatenate([[0.0], np.cumsum(chords)])

    def _at(self, parameters: Array) -> Array:
        """Points of the curve: cubic Hermite pieces between control points."""
        knots = self._parameters
        index = np.clip(np.searchsorted(knots, parameters, side="right") - 1, 0, len(knots) - 2)
        width = (knots[index + 1] - knots[index])[:, None]
        u = (parameters - knots[index])[:, None] / width
        u2, u3 = u * u, u * u * u
        start = (2 * u3 - 3 * u2 + 1) * self.points[index] + (u3 - 2 * u2 + u) * width * self._tangents[index]
        end = (3 * u2 - 2 * u3) * self.points[index + 1] + (u3 - u2) * width * self._tangents[index + 1]
        return start + end


def curves_of(cell: shared_map_pb2.CellMap) -> list[Curve]:
    """The lines of a cell, exactly: Catmull-Rom splines (tension 1/2) that reach their first and last control point."""
    anchor = Anchor.of(cell.anchor)
    return [_curve(cell.cell, anchor, lane) for lane in cell.lanes if len(lane.xyz_mm) >= 6]


def _curve(cell: str, anchor: Anchor, lane: shared_map_pb2.FusedLane) -> Curve:
    steps_mm = np.array(lane.xyz_mm, dtype=np.int64).reshape(-1, 3)
    points: Array = np.cumsum(steps_mm, axis=0).astype(np.float64) * 1e-3
    # A phantom point beyond each end: the reflection of the end's neighbour about the end.
    beyond = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    return Curve(
        id=lane.id,
        cell=cell,
        part=lane.part,
        category=Category(lane.category),
        category_probability=max(lane.category_posterior_permille, default=0) / 1000,
        drives=lane.drives,
        first_seen_ns=lane.first_seen_unix_ns,
        last_seen_ns=lane.last_seen_unix_ns,
        anchor=anchor,
        points=points,
        lateral_sigma_m=np.array(lane.lateral_sigma_mm, dtype=np.float64) * 1e-3,
        height_sigma_m=np.array(lane.height_sigma_mm, dtype=np.float64) * 1e-3,
        existence=np.array(lane.existence_permille, dtype=np.float64) * 1e-3,
        _parameters=np.arange(len(points), dtype=np.float64),
        _tangents=(beyond[2:] - beyond[:-2]) / 2,
    )
