"""Reads spline tiles: the bits that `lanemap/v1/spline_tile.proto` describes, in its order and by its names."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, sqrt

import numpy as np

from ._curves import Anchor, Curve
from ._values import Array, Category
from .errors import MapError
from .v1 import observation_pb2, spline_tile_pb2

LENGTHS_MM = [1000, 1500, 2000, 3000, 4000, 5000, 6000, 7500, 9000, 11000, 13500, 16500, 20000, 25000]
MEASURED, FREE = 14, 15
# Categories as LaneCategory lists them.
CATEGORIES = [Category(value) for value in observation_pb2.LaneCategory.values()]
MOST_POINTS = 1 << 20

Millimetres = tuple[int, int, int]
Codes = tuple[int, int, int]


class _Bits:
    """A string of bits, the highest of each byte first."""

    def __init__(self, text: bytes) -> None:
        self._text, self._at = "".join(f"{byte:08b}" for byte in text), 0

    def u(self, count: int) -> int:
        end = self._at + count
        if end > len(self._text):
            raise EOFError
        value = int(self._text[self._at : end] or "0", 2)
        self._at = end
        return value

    def e(self, order: int) -> int:
        one = self._text.find("1", self._at)
        zeros = one - self._at
        if one < 0 or zeros + order > 61:
            raise EOFError
        self._at = one + 1
        return (1 << (zeros + order)) - (1 << order) + self.u(zeros + order)

    def s(self, order: int) -> int:
        value = self.e(order)
        return (value >> 1) ^ -(value & 1)


@dataclass
class _Before:
    """What a line is coded against."""

    witness: int = 0
    lane: int = 0
    first: Millimetres = (0, 0, 0)
    codes: Codes = (0, 0, 0)


def curves_of_tile(tile: spline_tile_pb2.SplineTile) -> list[Curve]:
    """The lines of a tile, within 1 cm of those of the map."""
    return [curve for cell in tile.cells for curve in _curves(cell)]


def _curves(cell: spline_tile_pb2.SplineCell) -> list[Curve]:
    anchor, before, bits = Anchor.of(cell.anchor), _Before(), _Bits(cell.lines)
    try:
        return [_curve(cell, anchor, before, bits) for _ in range(cell.count)]
    except (EOFError, IndexError):
        raise MapError(f"the bits of cell {cell.cell} of a spline tile are no lines") from None


def _curve(cell: spline_tile_pb2.SplineCell, anchor: Anchor, before: _Before, bits: _Bits) -> Curve:
    witness = before.witness + bits.e(0)
    lane = (bits.s(5) + (before.lane if witness == before.witness else 0)) % (1 << 64)
    piece, stretch, part = bits.e(0), bits.e(0), bits.e(0)
    category, doubt_percent = CATEGORIES[bits.u(4)], bits.e(0)
    drives = bits.e(1) + 1
    started_ns, drive = sum(cell.witness_started_unix_ns[: witness + 1]), cell.witness_drives[witness]
    last_seen_s = started_ns // 10**9 + bits.s(8)
    if bits.u(1):
        bits.s(12)  # The last drive that confirmed it.
    for _ in range(2):
        if bits.u(1):
            _skip_border(bits)
    points, codes = _points(cell, bits.e(3) + 2, before, bits)
    before.witness, before.lane = witness, lane
    positions = np.array(points, dtype=np.float64) * 1e-3
    known = np.array(codes, dtype=np.float64)
    parameters, tangents = _course(positions)
    return Curve(
        id=f"{started_ns % (1 << 64):016x}-{drive:016x}-{lane:x}-{piece}-{stretch}",
        cell=cell.cell,
        part=part,
        category=category,
        category_probability=1 - min(doubt_percent, 100) / 100,
        drives=drives,
        first_seen_ns=started_ns,
        last_seen_ns=last_seen_s * 10**9,
        anchor=anchor,
        points=positions,
        lateral_sigma_m=_sigma_m(known[:, 0]),
        height_sigma_m=_sigma_m(known[:, 1]),
        existence=known[:, 2] / 100,
        _parameters=parameters,
        _tangents=tangents,
    )


def _skip_border(bits: _Bits) -> None:
    bits.s(23), bits.s(23), bits.s(14)
    if bits.u(1):
        bits.u(3)
        if bits.u(1):
            bits.e(0), bits.e(5), bits.e(0), bits.e(0)
        bits.e(0)


def _points(
    cell: spline_tile_pb2.SplineCell, count: int, before: _Before, bits: _Bits
) -> tuple[list[Millimetres], list[Codes]]:
    if count > MOST_POINTS:
        raise EOFError
    here = _moved(before.first, bits, (15, 15, 9))
    before.first, before.codes = here, _known(before.codes, bits, 3, 3)
    points, codes = [here], [before.codes]
    for _ in range(1, count):
        length = bits.u(4)
        if length == FREE:
            here = _moved(here, bits, (13, 13, 7))
        else:
            length_mm = bits.e(12) if length == MEASURED else LENGTHS_MM[length]
            here = _step(points[-2], here, length_mm, bits.s(cell.left_order), bits.s(cell.up_order))
        if bits.u(1):
            before.codes = _known(before.codes, bits, 0, 1)
        points.append(here)
        codes.append(before.codes)
    return points, codes


def _moved(here: Millimetres, bits: _Bits, orders: Millimetres) -> Millimetres:
    x, y, z = (at + bits.s(order) for at, order in zip(here, orders))
    return x, y, z


def _step(earlier: Millimetres, here: Millimetres, length: float, left: float, up: int) -> Millimetres:
    dx, dy, dz = (float(b - a) for a, b in zip(earlier, here))
    chord = sqrt(dx * dx + dy * dy)
    ux, uy, climb = (dx / chord, dy / chord, dz / chord) if chord else (1.0, 0.0, 0.0)
    x = here[0] + floor(ux * length - uy * left + 0.5)
    y = here[1] + floor(uy * length + ux * left + 0.5)
    return x, y, here[2] + floor(climb * length + 0.5) + up


def _known(codes: Codes, bits: _Bits, order: int, existence_order: int) -> Codes:
    lateral = codes[0] + bits.s(order)
    height = lateral + codes[1] - codes[0] + bits.s(order)
    return lateral, height, codes[2] + bits.s(existence_order)


def _sigma_m(codes: Array) -> Array:
    return np.where(codes > 0, 2 ** ((codes - 1) / 4) * 1e-3, 0.0)


def _course(points: Array) -> tuple[Array, Array]:
    """The parameter at each control point, the length of the chords before it, and the derivative by it."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / np.where(lengths > 0, lengths, 1)[:, None]
    tangents = np.empty_like(points)
    if len(points) == 2:
        tangents[:] = directions
    else:
        before, after = lengths[:-1, None], lengths[1:, None]
        both = np.where(before + after > 0, before + after, 1)
        tangents[1:-1] = (directions[:-1] * after + directions[1:] * before) / both
        tangents[0] = 2 * directions[0] - tangents[1] if lengths[0] else tangents[1]
        tangents[-1] = 2 * directions[-1] - tangents[-2] if lengths[-1] else tangents[-2]
    return np.concatenate([[0.0], np.cumsum(lengths)]), tangents
