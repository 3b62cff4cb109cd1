"""Spline tiles: the golden file is read as every reader must."""

import json
import unittest
from pathlib import Path

import numpy as np

from lanemap import MapError
from lanemap._spline_tiles import curves_of_tile
from lanemap.v1 import observation_pb2, spline_tile_pb2

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"


def tile():
    return spline_tile_pb2.SplineTile.FromString((GOLDEN / "spline_tile.pb").read_bytes())


class SplineTiles(unittest.TestCase):
    def test_the_golden_tile_is_read_as_every_reader_must(self):
        wanted = json.loads((GOLDEN / "spline_tile.json").read_text())
        lines = [(cell["cell"], line) for cell in wanted["cells"] for line in cell["lines"]]
        curves = curves_of_tile(tile())
        self.assertEqual(len(curves), len(lines))
        for curve, (cell, line) in zip(curves, lines):
            self.assertEqual((curve.cell, curve.id, curve.part, curve.drives), (cell, line["id"], line["part"], line["drives"]))
            self.assertEqual(observation_pb2.LaneCategory.Name(int(curve.category)), line["category"])
            self.assertAlmostEqual(curve.category_probability, line["category_probability"])
            self.assertEqual(curve.last_seen_ns, line["last_seen_unix_s"] * 10**9)
            np.testing.assert_array_equal(np.round(curve.points * 1e3), line["control_points_mm"])
            for sample in line["samples"]:
                at = np.array([sample["parameter_m"]])
                np.testing.assert_allclose(curve._at(at)[0], sample["position_m"], atol=1e-9)
                for name in ("lateral_sigma_m", "height_sigma_m", "existence"):
                    known = np.interp(at, curve._parameters, getattr(curve, name))
                    np.testing.assert_allclose(known, sample[name], atol=1e-9)

    def test_bits_that_are_no_lines_are_refused(self):
        cut = tile()
        cut.cells[0].lines = cut.cells[0].lines[:-8]
        with self.assertRaisesRegex(MapError, "no lines"):
            curves_of_tile(cut)


if __name__ == "__main__":
    unittest.main()
