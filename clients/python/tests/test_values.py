"""What is wrong with an input is said before anything is sent: field, value, limit."""

import unittest

import lanemap
import numpy as np
from lanemap import _values

LINE = [[5.0, 1.75, 0.0], [10.0, 1.75, 0.0]]


def frame(**changes):
    given = dict(sequence=1, time_ns=1, pose=lanemap.Pose(), detections=[LINE], gnss=None, motion_covariance=None)
    return _values.frame(**{**given, **changes}, limits=lanemap.Limits())


class Values(unittest.TestCase):
    def assertRefused(self, *words, **changes):
        with self.assertRaises(ValueError) as raised:
            frame(**changes)
        for word in words:
            self.assertIn(word, str(raised.exception))

    def test_a_frame_of_arrays_is_what_the_wire_has(self):
        message = frame(
            pose=lanemap.Pose.planar(3, 4, 0.5),
            detections=[np.array(LINE), lanemap.Detection(LINE, "white_solid"), lanemap.Detection(LINE, 20)],
            gnss=lanemap.GnssFix(48.1, 11.6, yaw_enu_rad=0.5),
            motion_covariance=np.diag([1.0, 2, 3, 4, 5, 6]),
        )
        self.assertEqual([line.category for line in message.detections], [0, 2, 20])
        self.assertEqual(list(message.detections[0].xyz), [5.0, 1.75, 0.0, 10.0, 1.75, 0.0])
        self.assertEqual(len(message.odometry.motion_covariance.upper_triangle), 21)
        self.assertEqual(message.odometry.motion_covariance.upper_triangle[6], 2.0)
        self.assertEqual(message.gnss.position.latitude_deg, 48.1)

    def test_what_is_hidden_is_what_the_wire_has_and_nothing_unless_said(self):
        hidden = frame(occlusions=[lanemap.Occlusion(-0.1, 0.2, 15)]).occlusions
        self.assertEqual([(part.from_rad, part.to_rad, part.range_m) for part in hidden], [(-0.1, 0.2, 15.0)])
        self.assertEqual(len(frame().occlusions), 0)
        self.assertRefused("occlusions[0].to_rad is 0", "1 to 7.28", occlusions=[lanemap.Occlusion(1, 0, 15)])
        self.assertRefused("occlusions[1].range_m is nan", occlusions=[lanemap.Occlusion(0, 1, 15), lanemap.Occlusion(0, 1, float("nan"))])
        self.assertRefused("occlusions has 65 entries", "64", occlusions=[lanemap.Occlusion(0, 1, 15)] * 65)

    def test_bad_numbers_are_named_with_value_and_limit(self):
        self.assertRefused("detections[0].points[1, 1] is nan", "finite", detections=[[[0, 0, 0], [1, float("nan"), 0]]])
        self.assertRefused("detections[1].points[0, 0] is 501.0", "500.0 m", detections=[LINE, [[501, 0, 0], [1, 0, 0]]])
        self.assertRefused("detections[0].points has the shape (2, 2)", "(n, 3)", detections=[[[1, 2], [3, 4]]])
        self.assertRefused("detections[0].points has 1 points", "2 to 4096", detections=[[[1, 2, 3]]])
        self.assertRefused("detections has 65 entries", "64", detections=[LINE] * 65)
        self.assertRefused("category is 'purple'", "WHITE_SOLID (2)", detections=[lanemap.Detection(LINE, "purple")])
        self.assertRefused("gnss.latitude_deg is 91", "-90 to 90", gnss=lanemap.GnssFix(91, 0))
        self.assertRefused("pose.x is 100000000.0", "-10000000.0 to 10000000.0", pose=lanemap.Pose(x=1e8))
        self.assertRefused("norm 2.0", "1 +- 0.001", pose=lanemap.Pose(qw=2.0))
        self.assertRefused("pose has the shape (3, 3)", "(4, 4)", pose=np.eye(3))
        self.assertRefused("pose[:3, :3] is no rotation", pose=np.diag([2.0, 1, 1, 1]))
        self.assertRefused("shape (3, 3)", "(6, 6)", motion_covariance=np.eye(3))
        self.assertRefused("negative eigenvalue", motion_covariance=np.diag([1.0, 1, 1, 1, 1, -1]))
        self.assertRefused("time_ns is 1.5", "whole number", time_ns=1.5)
        self.assertRefused("detections[0].points is str", "array of numbers", detections=["text"])

    def test_a_matrix_and_its_pose_are_the_same(self):
        random = np.random.default_rng(1)
        for _ in range(200):
            quaternion = random.normal(size=4)
            quaternion /= np.linalg.norm(quaternion)
            pose = lanemap.Pose(1, 2, 3, *quaternion)
            again = lanemap.Pose.from_matrix(pose.matrix())
            np.testing.assert_allclose(again.matrix(), pose.matrix(), atol=1e-12)

    def test_a_session_that_cannot_be_meant_is_refused_before_it_connects(self):
        camera = lanemap.Sensor(lanemap.Pose(), axes="vehicle")
        good = dict(url="http://127.0.0.1:1", fleet="f", vehicle="v", drive="d", sensor=camera)
        for changes, words in [
            (dict(fleet=""), "fleet has 0 characters, limit: 1 to 128"),
            (dict(drive="x" * 129), "drive has 129 characters"),
            (dict(url="ftp://host"), "url is 'ftp://host'"),
            (dict(preset="fast"), "preset is 'fast', limit: one of 'default', 'paper'"),
            (dict(sensor=lanemap.Sensor(lanemap.Pose(), axes="camera")), "sensor.axes is 'camera'"),
            (dict(sensor=lanemap.Sensor(lanemap.Pose(x=101), axes="vehicle")), "sensor.vehicle_from_sensor.x is 101"),
            (dict(max_unacked=0), "max_unacked is 0"),
        ]:
            with self.subTest(words), self.assertRaises(ValueError) as raised:
                lanemap.Session(**{**good, **changes})
            self.assertIn(words, str(raised.exception))

    def test_credentials_do_not_show_their_token(self):
        self.assertNotIn("secret", repr(lanemap.Credentials(token="secret")))


if __name__ == "__main__":
    unittest.main()
