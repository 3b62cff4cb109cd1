"""The shared map, read over HTTP."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from ._curves import Curve, curves_of
from ._http import Http
from ._link import Credentials
from ._map_events import LaneHistory, MapEvent, event_of, history_of
from ._spline_tiles import curves_of_tile
from ._values import Array
from ._watch import Watch
from .errors import MapError
from .v1 import shared_map_pb2, spline_tile_pb2

# Features, and cells, that are asked for at a time.
PAGE = 1000


@dataclass(frozen=True, eq=False)
class Feature:
    """A feature of a collection, as GeoJSON has it."""

    id: str
    properties: dict[str, Any]
    geometry: str
    """Its type, e.g. LineString."""
    coordinates: Array = field(repr=False)
    """(n, 3), or (3,) for a point: longitude, latitude, degrees, and height, metres. Of several lines, all in a row."""


@dataclass(frozen=True)
class Cell:
    """What is told of a cell: a web-mercator tile at zoom 14."""

    id: str
    version: int
    drives: int
    lanes: int
    line_km: float
    median_lateral_sigma_m: float | None
    dirty: bool
    """Whether drives have said something that is not in it yet."""
    fused_at: str
    bbox: tuple[float, float, float, float]
    """West, south, east, north, degrees."""

    def touches(self, bbox: Sequence[float]) -> bool:
        """Whether it touches a box: west, south, east, north; west above east runs over the antimeridian."""
        west, south, east, north = bbox
        across = [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]
        beside = any(self.bbox[0] <= high and self.bbox[2] >= low for low, high in across)
        return beside and self.bbox[1] <= north and self.bbox[3] >= south


class Map:
    """The shared map of a service.

        with lanemap.Map("http://localhost:8080") as map:
            for feature in map.features(bbox=(11.5, 48.1, 11.6, 48.2)):
                print(feature.id, feature.properties["category"])
            for curve in map.splines(bbox=(11.5, 48.1, 11.6, 48.2)):
                print(curve.sample(step_m=0.5).wgs84)
            for news in map.watch():
                match news:
                    case lanemap.Change():
                        print(news.cell, "is at version", news.to_version)
                    case lanemap.MapEvent():
                        print(news.kind, news.lane, news.probability)

    Answers are kept by their entity tags, `cache_bytes` of them, and travel again only where they changed. A service that
    is busy is asked again, up to `retries` times, when it says so. Threads may share a map.
    """

    def __init__(
        self,
        url: str,
        *,
        token: str | None = None,
        credentials: Credentials | None = None,
        timeout_s: float = 30.0,
        retries: int = 5,
        cache_bytes: int = 64 * 1024 * 1024,
    ) -> None:
        if token is not None and credentials is not None:
            raise ValueError("token and credentials are both given, limit: at most one")
        credentials = credentials if credentials is not None else Credentials(token=token)
        self._http = Http(url, credentials, timeout_s=timeout_s, retries=retries, cache_bytes=cache_bytes)

    def __enter__(self) -> Map:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of the network."""
        self._http.close()

    def features(
        self,
        collection: str = "lanes",
        *,
        bbox: Sequence[float] | None = None,
        datetime: str | None = None,
        page: int = PAGE,
        **filters: str | float,
    ) -> Iterator[Feature]:
        """The features of a collection, page by page as they are taken; `filters` are those of the collection."""
        given = None if bbox is None else _numbers("bbox", bbox, (4, 6))
        path = f"/collections/{collection}/items"
        address: str | None = self._http.address(path, bbox=given, datetime=datetime, limit=page, **filters)
        while address is not None:
            answer = self._http.json(address)
            for feature in answer["features"]:
                yield _feature(feature)
            address = self._next(address, answer)

    def cells(self, bbox: Sequence[float] | None = None) -> list[Cell]:
        """The cells of the map, or those that touch a box."""
        if bbox is not None:
            _numbers("bbox", bbox, (4,))
        cells: list[Cell] = []
        address: str | None = self._http.address("/cells", limit=PAGE)
        while address is not None:
            answer = self._http.json(address)
            cells.extend(_cell(entry) for entry in answer["cells"])
            address = self._next(address, answer)
        return [cell for cell in cells if bbox is None or cell.touches(bbox)]

    def cell(self, cell: str) -> list[Curve]:
        """The lines of one cell, exactly, as curves."""
        message = shared_map_pb2.CellMap()
        self._message(f"/cells/{cell}/lanes.pb", message)
        return curves_of(message)

    def splines(
        self, z: int | None = None, x: int | None = None, y: int | None = None, *, bbox: Sequence[float] | None = None
    ) -> list[Curve]:
        """The lines of a tile, within 1 cm, or of all cells that touch a box, exactly, as curves.

        A tile is small, and tells less: `first_seen_ns` of its lines is the start of the drive that they are named after.
        """
        tile = (z, x, y)
        if bbox is not None:
            if tile != (None, None, None):
                raise ValueError("a tile and a bbox are both given, limit: one of them")
            return [curve for cell in self.cells(bbox) if cell.lanes for curve in self.cell(cell.id)]
        if None in tile:
            raise ValueError(f"the tile is {tile}, limit: z, x and y, or a bbox")
        message = spline_tile_pb2.SplineTile()
        self._message(f"/splines/{z}/{x}/{y}", message)
        return curves_of_tile(message)

    def events(
        self,
        *,
        bbox: Sequence[float] | None = None,
        since: int | None = None,
        kinds: Iterable[str] | None = None,
        limit: int = PAGE,
    ) -> list[MapEvent]:
        """What happened, the newest first, at most `limit`: in a box, told since a revision of the map, of some kinds."""
        given = None if bbox is None else _numbers("bbox", bbox, (4, 6))
        named = None if kinds is None else ",".join(kinds)
        address = self._http.address("/events", bbox=given, since=since, kind=named, limit=limit)
        return [event_of(feature) for feature in self._http.json(address)["features"]]

    def history(self, cell: str, lane: str) -> LaneHistory:
        """How a line of a cell came to be, and what it became where its name went."""
        return history_of(self._http.json(self._http.address(f"/cells/{cell}/lanes/{lane}/history")))

    def watch(
        self,
        since: int | str | None = None,
        *,
        bbox: Sequence[float] | None = None,
        cells: Iterable[str] | None = None,
        lines: bool = False,
        silence_s: float = 60.0,
    ) -> Watch:
        """What changes in the map (`Change`), as it changes, from now on, and what happens to the road (`MapEvent`).

        An event is told before the change of the cell that tells of it.

        `since` is a revision of the map that one has (0: none, and every cell is told), or the `position` of another watch.
        With `lines` changes come with their lines, where these are not too large. A connection that breaks, or is silent
        for longer than `silence_s`, is made anew, and no change is missed.
        """
        parameters: dict[str, Any] = {}
        if bbox is not None:
            parameters["bbox"] = _numbers("bbox", bbox, (4, 6))
        if cells is not None:
            parameters["cell"] = ",".join(cells)
        if lines:
            parameters["content"] = "lines"
        return Watch(self._http, parameters, None if since is None else str(since), silence_s)

    def _next(self, address: str, answer: dict[str, Any]) -> str | None:
        links = [link["href"] for link in answer.get("links", []) if link.get("rel") == "next"]
        return self._http.beside(address, links[0]) if links else None

    def _message(self, path: str, message: Any) -> None:
        address = self._http.address(path)
        try:
            message.ParseFromString(self._http.body(address))
        except DecodeError as error:
            raise MapError(f"{address} is no message: {error}") from None


def _feature(feature: dict[str, Any]) -> Feature:
    geometry = feature["geometry"]
    nested = geometry["coordinates"]
    if geometry["type"] == "MultiLineString":
        nested = [place for line in nested for place in line]
    coordinates = np.array(nested, dtype=np.float64)
    return Feature(feature["id"], feature["properties"], geometry["type"], coordinates)


def _cell(entry: dict[str, Any]) -> Cell:
    west, south, east, north = entry["bbox"]
    return Cell(
        id=entry["id"],
        version=entry["version"],
        drives=entry["drives"],
        lanes=entry["lanes"],
        line_km=entry["line_km"],
        median_lateral_sigma_m=entry.get("median_lateral_sigma_m"),
        dirty=entry["dirty"],
        fused_at=entry["fused_at"],
        bbox=(west, south, east, north),
    )


def _numbers(name: str, numbers: Sequence[float], counts: tuple[int, ...]) -> str:
    values = [float(number) for number in numbers]
    if len(values) not in counts or not np.all(np.isfinite(values)):
        raise ValueError(f"{name} is {list(numbers)!r}, limit: {' or '.join(map(str, counts))} finite numbers")
    return ",".join(repr(value) for value in values)
