#!/usr/bin/env python3
"""Golden values for the incremental smoothing of one lane, from GTSAM's iSAM2.

    python3 -m venv target/venv && target/venv/bin/pip install -r tests/golden/requirements.txt
    target/venv/bin/python tests/golden/isam2.py            # writes tests/golden/isam2.json
    target/venv/bin/python tests/golden/isam2.py --check    # recomputes, and fails where the file differs

One lane is a chain of control points P_i in R^3 (i an integer, negative where the lane grew at its head). Two kinds of
factor, both linear, so that iSAM2 has no linearisation error and must equal least squares exactly:

* point: r = sum_k w_k P_{first+k} - q, k = 0..3, isotropic sigma. The weights are the Catmull-Rom basis at tau = 1/2. On a
  lane's end segment the fourth control point is a phantom, the reflection of the end's neighbour: 2 P_0 - P_1 before the
  head, 2 P_n - P_{n-1} behind the tail. It is folded onto the three real ones, and the fourth weight is 0.
* chord: r = P_{index+1} - P_index - delta, isotropic sigma; once per pair, when the younger of the two is born, with delta
  as the pair stood then (the younger's initial value, the older's estimate).

iSAM2 is fed frame by frame with its wildfire threshold at 0, so that back-substitution stops nowhere. The script fails
unless estimate and covariances equal numpy's dense least squares on all factors so far.

Schema of isam2.json. Metres throughout; numbers are the shortest decimals that read back as the same doubles.

    generator        {gtsam, numpy}: versions that wrote the file
    frames[]         in order:
      born[]           {index, initial[3]}: control points that join the chain, in that order, each next to one already there
      chords[]         {index, delta[3], sigma}: on P_{index+1} - P_index
      points[]         {first, weights[4], point[3], sigma}: a control point that has weight 0 need not exist
      estimate         {first, positions[n][3]}: of all control points first .. first+n-1, after this frame's update
      covariances[]    {index, covariance[3][3]}: marginals after this frame's update; empty for most frames
"""
import argparse
import json
import pathlib
import sys
from importlib.metadata import version

import gtsam
import numpy as np

FRAMES = 25
CHORD_M = 3.0
BEND_RADIUS_M = 60.0
CHORD_SIGMA_M = 1.0
SEED = 20230713
TOLERANCE_M = 1e-9
FRAMES_WITH_COVARIANCES = (0, 7, 15, 24)
FILE = pathlib.Path(__file__).with_name("isam2.json")


def lane(index):
    """The true lane near control point `index`: a bend of 60 m radius that climbs 2 %, far from the origin."""
    s = CHORD_M * index
    bend = BEND_RADIUS_M * np.array([np.sin(s / BEND_RADIUS_M), 1.0 - np.cos(s / BEND_RADIUS_M)])
    return np.array([4210.0 + bend[0], -1730.0 + bend[1], 12.0 + 0.02 * s])


def basis(u):
    """Weights of the four control points of a segment at parameter u, tau = 1/2 (paper, eq. 2)."""
    return 0.5 * np.array([1.0, u, u * u, u**3]) @ np.array(
        [[0.0, 2.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [2.0, -5.0, 4.0, -1.0], [-1.0, 3.0, -3.0, 1.0]]
    )


def spline_weights(segment, u, head, tail):
    """First control point and four weights of the point at u between P_segment and P_{segment+1}; both ends reflected."""
    before, here, after, beyond = basis(u)
    if segment == head:
        return head, [here + 2.0 * before, after - before, beyond, 0.0]
    if segment + 1 == tail:
        return segment - 1, [before, here - beyond, after + 2.0 * beyond, 0.0]
    return segment - 1, [before, here, after, beyond]


def frame_births(frame, random):
    """How many control points are born at the head and at the tail: none in two frames, at the head alone in one."""
    if frame == 0:
        return 0, 8
    at_head = int(frame in (3, 4, 9, 14, 20)) + int(frame == 14)
    at_tail = 0 if frame in (6, 14, 21) else int(random.integers(1, 3)) if frame % 4 else 1
    return at_head, at_tail


def observed_segments(frame, head, tail):
    """Segments that this frame sees: those before the vehicle; the head where it grew there; in two frames, all."""
    if frame in (11, 24):
        return np.arange(head, tail)
    ahead = np.arange(max(head, tail - 12), tail)
    if frame in (3, 4, 9, 14, 20):
        return np.concatenate([np.arange(head, head + 3), ahead[-4:]])
    return ahead if frame % 5 else ahead[:7]


def observe(frame, head, tail, random):
    """Noisy points on the lane, each with the weights of its foot point."""
    segments = observed_segments(frame, head, tail)
    points = []
    for _ in range(int(random.integers(10, 31))):
        segment, u = int(random.choice(segments)), float(random.uniform())
        first, weights = spline_weights(segment, u, head, tail)
        sigma = round(0.1 + 0.9 * float(random.uniform()), 3)
        point = lane(segment + u) + random.normal(0.0, sigma, 3)
        points.append({"first": first, "weights": weights, "point": point.round(6).tolist(), "sigma": sigma})
    return points


def grow(count_head, count_tail, estimate, random):
    """Control points born one chord beyond the ends, and the chordal terms that tie them to the chain."""
    chain = dict(estimate)
    born, chords = [], []
    indices = list(range(count_tail)) if not chain else []
    if chain:
        head, tail = min(chain), max(chain)
        indices = [head - 1 - k for k in range(count_head)] + [tail + 1 + k for k in range(count_tail)]
    for index in indices:
        chain[index] = (lane(index) + random.normal(0.0, 0.4, 3)).round(6)
        born.append({"index": index, "initial": chain[index].tolist()})
        for lower in (index - 1, index):
            if lower in chain and lower + 1 in chain:
                delta = (chain[lower + 1] - chain[lower]).round(6)
                chords.append({"index": lower, "delta": delta.tolist(), "sigma": CHORD_SIGMA_M})
    return born, chords


def rows(factors):
    """Each factor as (weight by control point, right-hand side, sigma)."""
    for kind, factor in factors:
        if kind == "chord":
            yield {factor["index"]: -1.0, factor["index"] + 1: 1.0}, np.array(factor["delta"]), factor["sigma"]
        else:
            weights = {factor["first"] + k: w for k, w in enumerate(factor["weights"]) if w != 0.0}
            yield weights, np.array(factor["point"]), factor["sigma"]


def gtsam_key(index):
    return gtsam.symbol("p", 1000 + index)


def gtsam_factor(weights, right_hand_side, sigma):
    def error(_factor, values, jacobians):
        if jacobians is not None:
            for k, weight in enumerate(weights.values()):
                jacobians[k] = weight * np.eye(3)
        return sum(w * values.atPoint3(gtsam_key(i)) for i, w in weights.items()) - right_hand_side

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(3, sigma), [gtsam_key(i) for i in weights], error)


def dense_least_squares(indices, factors):
    """Positions, and the marginal variance of each control point (the three axes share one scalar system)."""
    column = {index: k for k, index in enumerate(indices)}
    matrix, target = [], []
    for weights, right_hand_side, sigma in rows(factors):
        row = np.zeros(len(indices))
        for index, weight in weights.items():
            row[column[index]] = weight / sigma
        matrix.append(row)
        target.append(right_hand_side / sigma)
    matrix, target = np.array(matrix), np.array(target)
    positions = np.linalg.lstsq(matrix, target, rcond=None)[0]
    return positions, np.diag(np.linalg.inv(matrix.T @ matrix))


def smoother():
    params = gtsam.ISAM2Params()
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    params.setFactorization("QR")
    return gtsam.ISAM2(params)


def run():
    random = np.random.default_rng(SEED)
    isam, frames, factors, estimate = smoother(), [], [], {}
    for number in range(FRAMES):
        born, chords = grow(*frame_births(number, random), estimate, random)
        indices = sorted([*estimate, *(point["index"] for point in born)])
        points = observe(number, indices[0], indices[-1], random)

        graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
        added = [("chord", c) for c in chords] + [("point", p) for p in points]
        for weights, right_hand_side, sigma in rows(added):
            graph.add(gtsam_factor(weights, right_hand_side, sigma))
        for point in born:
            initial.insert(gtsam_key(point["index"]), np.array(point["initial"]))
        isam.update(graph, initial)
        factors += added

        values = isam.calculateEstimate()
        estimate = {index: values.atPoint3(gtsam_key(index)) for index in indices}
        positions = np.array([estimate[index] for index in indices])
        expected, variances = dense_least_squares(indices, factors)
        worst = np.abs(positions - expected).max()
        if not worst < TOLERANCE_M:
            sys.exit(f"frame {number}: iSAM2 differs from dense least squares by {worst:.3g} m, limit {TOLERANCE_M:g}")

        covariances = []
        if number in FRAMES_WITH_COVARIANCES:
            for place in sorted({0, 1, len(indices) // 2, len(indices) - 2, len(indices) - 1}):
                covariance = isam.marginalCovariance(gtsam_key(indices[place]))
                if not np.allclose(covariance, variances[place] * np.eye(3), rtol=1e-9, atol=1e-12):
                    sys.exit(f"frame {number}: covariance of P_{indices[place]} differs from the dense inverse")
                covariances.append({"index": indices[place], "covariance": covariance.tolist()})
        estimated = {"first": indices[0], "positions": positions.tolist()}
        frames.append({"born": born, "chords": chords, "points": points, "estimate": estimated, "covariances": covariances})
    print(f"{len(indices)} control points, {len(factors)} factors, last frame within {worst:.2g} m of least squares")
    generator = {package: version(package) for package in ("gtsam", "numpy")}
    return {"generator": generator, "frames": frames}


def differs(a, b):
    """Whether two documents differ by more than rounding."""
    if isinstance(a, dict):
        return a.keys() != b.keys() or any(differs(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) != len(b) or any(differs(x, y) for x, y in zip(a, b))
    return abs(a - b) > 1e-5 if isinstance(a, (int, float)) else a != b


def main():
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--check", action="store_true", help="compare with isam2.json instead of writing it")
    document = run()
    if arguments.parse_args().check:
        if differs(json.loads(FILE.read_text())["frames"], document["frames"]):
            sys.exit(f"{FILE.name} is not what this script computes")
        return
    FILE.write_text(json.dumps(document, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main()
