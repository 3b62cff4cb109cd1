"""What happened to the road, and to the names of lines."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ._values import Array, Category


@dataclass(frozen=True, eq=False)
class MapEvent:
    """Something that happened. One that differs from what was told is told again under its id, and replaces it."""

    id: str
    kind: str
    """To the road: appeared, vanished, moved, repainted; to names of lines: renamed, merged, split. A newer service may tell more."""
    cell: str
    lane: str
    """The line, by its name; where it moved, the new one."""
    into: tuple[str, ...]
    """Names of the lines that bear its paint now, where its name went."""
    category: Category
    """Of the line; where it was repainted, of the stretch since then."""
    probability: float
    """That it happened, in [0, 1]."""
    withdrawn: bool
    """Whether it is believed no more."""
    noticed: str | None
    """Start of the drive with which it came to be believed, RFC 3339; None for names."""
    drives: int
    """Drives that saw the line."""
    moved_m: float | None
    """How far it moved, metres."""
    category_before: Category | None
    """What it was before it was repainted."""
    revision: int
    """The revision of the map that told of it last."""
    version: int
    """The version of the cell that did."""
    told_at: str
    """When that was published, RFC 3339."""
    coordinates: Array | None = field(repr=False)
    """Where the line is now, or was: (n, 3), longitude, latitude, degrees, and height, metres; None for names."""


@dataclass(frozen=True)
class Descent:
    """What became of the names of lines."""

    kind: str
    """renamed, merged or split."""
    lanes: tuple[str, ...]
    """The other lines, by their names."""
    version: int
    """The version of the cell that told of it."""
    at: str
    """When that was published, RFC 3339."""


@dataclass(frozen=True, eq=False)
class LaneHistory:
    """How a line of one cell came to be, as far as that is kept."""

    cell: str
    lane: str
    came_from: tuple[Descent, ...]
    """The lines that gave it paint."""
    became: tuple[Descent, ...]
    """The lines that bear its paint now, where its name went or part of it did."""
    events: tuple[MapEvent, ...]
    """What happened to its road."""
    versions: list[dict[str, Any]] = field(repr=False)
    """The versions of its cell in which it differed from the one before, as the service tells them, the oldest first."""


def event_of(feature: dict[str, Any]) -> MapEvent:
    """An event as GeoJSON has it."""
    known, geometry = feature["properties"], feature["geometry"]
    return MapEvent(
        id=feature["id"],
        kind=known["kind"],
        cell=known["cell"],
        lane=known["lane"],
        into=tuple(known.get("into", ())),
        category=Category[known["category"].upper()],
        probability=known["probability"],
        withdrawn=known["withdrawn"],
        noticed=known.get("noticed"),
        drives=known["drives"],
        moved_m=known.get("moved_m"),
        category_before=Category[known["category_before"].upper()] if "category_before" in known else None,
        revision=known["revision"],
        version=known["version"],
        told_at=known["told_at"],
        coordinates=None if geometry is None else np.array(geometry["coordinates"], dtype=np.float64),
    )


def history_of(told: dict[str, Any]) -> LaneHistory:
    """The answer of `/cells/{cell}/lanes/{lane}/history`."""

    def descents(entries: list[dict[str, Any]]) -> tuple[Descent, ...]:
        lanes = [tuple(entry["lanes"]) if "lanes" in entry else (entry["lane"],) for entry in entries]
        return tuple(Descent(entry["kind"], names, entry["version"], entry["at"]) for entry, names in zip(entries, lanes))

    return LaneHistory(
        cell=told["cell"],
        lane=told["lane"],
        came_from=descents(told["came_from"]),
        became=descents(told["became"]),
        events=tuple(event_of(feature) for feature in told["events"]),
        versions=told["versions"],
    )
