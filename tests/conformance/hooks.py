"""What OpenAPI 3.0 cannot say: which texts are cursors, cells and times, and which four numbers are a box."""

import json
import os
import random
import urllib.request

import schemathesis
from hypothesis import strategies as st

URL = os.environ["LANEMAP_URL"]
MOST_FEATURES = 10_000


def get(path):
    with urllib.request.urlopen(URL + path) as answer:
        return json.load(answer)


def next_cursor(collection):
    links = get(f"/collections/{collection}/items?limit=1")["links"]
    return next(link["href"] for link in links if link["rel"] == "next").rpartition("cursor=")[2]


REVISION = get("/timeline")["newest"]
CELL_14 = get("/cells")["cells"][0]["id"].split("-")
TILE = dict(zip("zxy", CELL_14))
# What is there, at addresses to which no link of the description leads.
THERE = {
    "/tiles/lanes/{z}/{x}/{y}": TILE,
    "/splines/{z}/{x}/{y}": TILE,
    "/cells/{id}/events": {"id": "-".join(CELL_14)},
    **{
        f"/collections/{name}/items/{{id}}": {"id": get(f"/collections/{name}/items?limit=1")["features"][0]["id"]}
        for name in ["lanes", "control_points", "cells", "drives"]
    },
}

instant = st.datetimes().map(lambda time: time.isoformat() + "Z")
open_end = st.sampled_from(["", ".."])
interval = st.tuples(st.datetimes(), st.datetimes()).map(lambda ends: "/".join(end.isoformat() + "Z" for end in sorted(ends)))
half_open = st.one_of(st.tuples(instant, open_end), st.tuples(open_end, instant)).map("/".join)
schemathesis.openapi.format("rfc3339-instant-or-interval", st.one_of(instant, interval, half_open))
schemathesis.openapi.format("lanemap-cell", st.sampled_from([cell["id"] for cell in get("/cells")["cells"]]))
schemathesis.openapi.format("lanemap-session", st.sampled_from([session["id"] for session in get("/sessions")["sessions"]]))
schemathesis.openapi.format("lanemap-map-cursor", st.sampled_from([next_cursor(name) for name in ["lanes", "cells"]]))
schemathesis.openapi.format("lanemap-drives-cursor", st.just(next_cursor("drives")))


def as_box(numbers):
    """The same numbers as a box: degrees in their ranges, south below north, low below high."""
    half = len(numbers) // 2
    low, high = list(numbers[:half]), list(numbers[half:])
    for axis, most in [(0, 180), (1, 90)]:
        low[axis], high[axis] = max(-most, min(most, low[axis])), max(-most, min(most, high[axis]))
    for axis in range(1, half):
        low[axis], high[axis] = sorted([low[axis], high[axis]])
    return low + high


def numbers(value):
    """The numbers of a list, or of a text in which it is written; nothing where there is anything else."""
    parts = value.split(",") if isinstance(value, str) else value
    try:
        return [float(part) for part in parts if not isinstance(part, bool)]
    except (TypeError, ValueError):
        return None


def whole_number(value):
    try:
        return int(value)
    except (TypeError, ValueError):
        return None


@schemathesis.hook
def before_call(context, case, kwargs):
    """Makes what the description allows what it means; what it does not allow stays as it is."""
    query, path = case.query or {}, case.path_parameters or {}
    is_allowed = all(isinstance(part, str) or (whole_number(part) or 0) >= 0 for part in path.values())
    if (there := THERE.get(case.operation.path)) and is_allowed and random.random() < 0.5:
        case.path_parameters.update({name: value for name, value in there.items() if type(path.get(name)) in (int, str)
                                     and (name == "id" or whole_number(path[name]) is not None)})
    box = numbers(query.get("bbox"))
    if box and len(box) in (4, 6):
        query["bbox"] = ",".join(map(str, as_box(box)))
    # More than the most features of a page counts as the most (OGC 17-069r4, requirement 22), though the description names
    # a maximum, as the standard does: what is not allowed is tried with 0.
    if (whole_number(query.get("limit")) or 0) > MOST_FEATURES:
        query["limit"] = 0
    # Of a revision that is yet to come nothing is told.
    if case.operation.path in ("/differences", "/tiles/lanes/{z}/{x}/{y}"):
        for name in ("since", "revision"):
            asked = whole_number(query.get(name))
            if asked is not None and 0 <= asked < 2**63:
                query[name] = asked % (REVISION + 1)
