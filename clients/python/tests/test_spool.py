"""The spool: what was taken and not acked is there, in order, whatever became of process and disk."""

import pathlib
import random
import struct
import tempfile
import unittest

from lanemap import SpoolError, SpoolFull, SpoolOptions, _records, _spool
from lanemap.v1 import ingest_service_pb2, observation_pb2

START = ingest_service_pb2.SessionStart(fleet_id="fleet", vehicle_id="vehicle", drive_id="drive")


def frame(sequence, points=40):
    line = observation_pb2.Detection(xyz=[sequence + 0.5] * 3 * points)
    return observation_pb2.Frame(sequence=sequence, time_unix_ns=1, detections=[line])


def sequences(spool):
    return [observation_pb2.Frame.FromString(spool.read(index)).sequence for index in range(len(spool))]


class Records(unittest.TestCase):
    def test_a_record_has_the_bytes_that_the_rust_client_writes(self):
        # The same bytes stand in clients/rust/src/spool/record.rs.
        record = _records.encode(_records.Kind.MARK, struct.pack("<Q", 7))
        self.assertEqual(record, b"\xf5lmr\x08\0\0\0\x70\xb4\x44\x71\x02\x07\0\0\0\0\0\0\0")

    def test_a_flipped_bit_anywhere_is_never_taken_for_a_record(self):
        whole = _records.encode(_records.Kind.FRAME, bytes(range(64)))
        for at in range(len(whole)):
            for bit in range(8):
                damaged = bytearray(whole)
                damaged[at] ^= 1 << bit
                self.assertIsNone(_records.decode(bytes(damaged)), f"bit {bit} of byte {at}")


class Spool(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(self.enterContext(tempfile.TemporaryDirectory()))

    def open(self, max_bytes=_spool.MIN_BYTES, start=START):
        spool = _spool.Spool(SpoolOptions(self.folder, max_bytes=max_bytes), start)
        self.addCleanup(spool.close, delivered=False)
        return spool

    def files(self):
        return sorted(self.folder.glob("fleet/vehicle/drive/*.spool"))

    def bytes_on_disk(self):
        return sum(path.stat().st_size for path in self.files())

    def fill(self, spool, first):
        for sequence in range(first, first + 10_000):
            try:
                spool.append(frame(sequence))
            except SpoolFull as full:
                self.assertIn(str(_spool.MIN_BYTES), str(full))
                return sequence - first
        raise AssertionError("never full")

    def test_what_one_process_spooled_the_next_one_finds_in_order(self):
        spool = self.open()
        for sequence in (1, 2, 5, 9):
            spool.append(frame(sequence))
        spool.close(delivered=False)
        spool = self.open()
        self.assertEqual(sequences(spool), [1, 2, 5, 9])
        self.assertEqual((spool.recovery.frames, spool.recovery.torn_bytes, spool.last_sequence), (4, 0, 9))

    def test_a_record_that_was_not_written_whole_is_cut_off_and_those_before_it_stay(self):
        spool = self.open()
        for sequence in (1, 2, 3):
            spool.append(frame(sequence))
        spool.close(delivered=False)
        (path,) = self.files()
        whole = path.read_bytes()
        length = len(_records.encode(_records.Kind.FRAME, frame(3).SerializeToString()))
        for cut in (1, 7, length - 1):
            path.write_bytes(whole[:-cut])
            spool = self.open()
            self.assertEqual(sequences(spool), [1, 2])
            self.assertEqual(spool.recovery.torn_bytes, length - cut)
            spool.append(frame(4))
            spool.close(delivered=False)
            spool = self.open()
            self.assertEqual(sequences(spool), [1, 2, 4])
            spool.close(delivered=False)

    def test_a_damaged_record_costs_itself_alone_and_is_reported(self):
        spool = self.open()
        for sequence in range(1, 6):
            spool.append(frame(sequence))
        damaged = spool._frames[2]
        spool.close(delivered=False)
        (path,) = self.files()
        data = bytearray(path.read_bytes())
        data[damaged.offset + 5] ^= 0x55
        path.write_bytes(data)
        spool = self.open()
        self.assertEqual(sequences(spool), [1, 2, 4, 5])
        self.assertEqual(spool.recovery.damaged_bytes, damaged.length)
        spool.append(frame(6))
        spool.close(delivered=False)
        self.assertEqual(sequences(self.open()), [1, 2, 4, 5, 6])

    def test_a_full_spool_says_so_keeps_its_bound_and_takes_more_once_frames_are_acked(self):
        spool = self.open()
        taken = self.fill(spool, 1)
        self.assertGreater(taken, 40)
        self.assertLessEqual(self.bytes_on_disk(), _spool.MIN_BYTES)
        self.assertEqual(sequences(spool), list(range(1, taken + 1)))
        spool.forget_up_to(taken // 2)
        self.assertGreater(self.fill(spool, taken + 1), taken // 4)
        self.assertLessEqual(self.bytes_on_disk(), _spool.MIN_BYTES)
        with self.assertRaisesRegex(ValueError, "max_bytes = 65536"):
            spool.append(frame(10**6, points=3000))

    def test_numbers_given_are_remembered_when_all_frames_are_acked(self):
        spool = self.open()
        taken = self.fill(spool, 1)
        spool.forget_up_to(taken)
        spool.close(delivered=False)
        self.assertEqual(self.open().last_sequence, taken)

    def test_a_second_process_on_the_same_drive_is_kept_out(self):
        first = self.open()
        with self.assertRaisesRegex(SpoolError, "in use"):
            self.open()
        first.close(delivered=True)
        self.assertEqual(list(self.folder.iterdir()), [])

    def test_an_id_that_is_a_path_stays_within_the_spool(self):
        self.assertEqual(_spool._folder_name(".."), "%2E.")
        self.assertEqual(_spool._folder_name("../../etc"), "%2E.%2F..%2Fetc")
        self.assertLessEqual(len(_spool._folder_name("道" * 128)), 200)

    def test_nothing_taken_is_lost_whatever_happens(self):
        for seed in range(20):
            with self.subTest(seed=seed):
                self.random_steps(random.Random(seed), ingest_service_pb2.SessionStart(
                    fleet_id="fleet", vehicle_id="random", drive_id=str(seed)))

    def random_steps(self, chance, start):
        spool, expected, acked, following = self.open(max_bytes=2**20, start=start), [], 0, 1
        for _ in range(150):
            step = chance.choices(["append", "ack", "restart"], [8, 2, 1])[0]
            if step == "append":
                spool.append(frame(following, points=chance.randrange(200)))
                expected.append(following)
                following += 1
            elif step == "ack":
                acked = max(acked, chance.randrange(following))
                spool.forget_up_to(acked)
                expected = [sequence for sequence in expected if sequence > acked]
            else:
                folder = spool.folder
                spool.close(delivered=False)
                newest = sorted(folder.glob("*.spool"))[-1]
                torn = _records.encode(_records.Kind.FRAME, bytes(60))[: chance.randrange(60)]
                newest.write_bytes(newest.read_bytes() + torn)
                spool = self.open(max_bytes=2**20, start=start)
                self.assertEqual((spool.recovery.torn_bytes, spool.recovery.damaged_bytes), (len(torn), 0))
                spool.forget_up_to(acked)
            self.assertEqual(sequences(spool), expected)
        spool.close(delivered=True)


if __name__ == "__main__":
    unittest.main()
