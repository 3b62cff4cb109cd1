use proptest::prelude::*;
use tempfile::TempDir;

use super::*;

fn start() -> v1::SessionStart {
    v1::SessionStart {
        fleet_id: "fleet".into(),
        vehicle_id: "vehicle".into(),
        drive_id: "drive".into(),
        ..Default::default()
    }
}

/// A frame of about `points` times 24 bytes.
fn frame(sequence: u64, points: usize) -> v1::Frame {
    let detection = v1::Detection { category: 1, xyz: vec![sequence as f64 + 0.5; 3 * points] };
    v1::Frame { sequence, time_unix_ns: 1, detections: vec![detection], ..Default::default() }
}

fn options(folder: &TempDir, max_bytes: u64) -> SpoolOptions {
    SpoolOptions { max_bytes, ..SpoolOptions::new(folder.path()) }
}

fn open(folder: &TempDir) -> Spool {
    Spool::open(&options(folder, 1 << 20), &start()).unwrap()
}

fn sequences(spool: &mut Spool) -> Vec<u64> {
    (0..spool.len()).map(|index| spool.read(index).unwrap().unwrap().sequence).collect()
}

fn segment_files(spool: &Spool) -> Vec<PathBuf> {
    let numbers = segment::numbers(&spool.folder).unwrap();
    numbers.into_iter().map(|number| spool.folder.join(segment::file_name(number))).collect()
}

#[test]
fn what_one_process_spooled_the_next_one_finds_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open(&folder);
    for sequence in [1, 2, 5, 4, 9] {
        spool.append(&frame(sequence, 10)).unwrap();
    }
    drop(spool);
    let mut spool = open(&folder);
    assert_eq!(sequences(&mut spool), [1, 2, 5, 4, 9]);
    assert_eq!(spool.read(2).unwrap().unwrap(), frame(5, 10));
    assert_eq!(*spool.recovery(), SpoolRecovery { frames: 5, ..SpoolRecovery::default() });
    assert_eq!(spool.last_sequence(), Some(9));
}

#[test]
fn a_record_that_was_not_written_whole_is_cut_off_and_those_before_it_stay() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open(&folder);
    for sequence in 1..=3 {
        spool.append(&frame(sequence, 10)).unwrap();
    }
    let file = segment_files(&spool).remove(0);
    drop(spool);
    let whole = fs::read(&file).unwrap();
    let last = record::HEADER_BYTES + frame(3, 10).encoded_len();
    for cut in [1, 5, last - 1] {
        fs::write(&file, &whole[..whole.len() - cut]).unwrap();
        let mut spool = open(&folder);
        assert_eq!(sequences(&mut spool), [1, 2], "{cut} bytes cut off");
        assert_eq!(spool.recovery().torn_bytes, (last - cut) as u64);
        spool.append(&frame(4, 10)).unwrap();
        drop(spool);
        assert_eq!(sequences(&mut open(&folder)), [1, 2, 4]);
    }
}

#[test]
fn a_damaged_record_costs_itself_alone_and_is_reported() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open(&folder);
    for sequence in 1..=5 {
        spool.append(&frame(sequence, 10)).unwrap();
    }
    let third = spool.frames[2].place;
    let file = segment_files(&spool).remove(0);
    drop(spool);
    let whole = fs::read(&file).unwrap();
    // Its marker, its length, its checksum, its kind, its body: whatever it is that was changed.
    for at in [0, 4, 9, 12, 40] {
        let mut bytes = whole.clone();
        bytes[usize::try_from(third.offset).unwrap() + at] ^= 0x55;
        fs::write(&file, &bytes).unwrap();
        let mut spool = open(&folder);
        assert_eq!(sequences(&mut spool), [1, 2, 4, 5], "byte {at} of the record");
        assert_eq!(spool.recovery().damaged_bytes, third.length as u64);
        // What comes after the damage is found again, in a segment of its own.
        spool.append(&frame(6, 10)).unwrap();
        drop(spool);
        assert_eq!(sequences(&mut open(&folder)), [1, 2, 4, 5, 6]);
        fs::remove_dir_all(file.parent().unwrap()).unwrap();
        fs::create_dir_all(file.parent().unwrap()).unwrap();
    }
}

#[test]
fn a_segment_that_is_no_segment_any_more_is_reported_and_costs_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open_small(&folder);
    let mut sequence = 0;
    while segment_files(&spool).len() < 3 {
        sequence += 1;
        spool.append(&frame(sequence, 40)).unwrap();
    }
    let files = segment_files(&spool);
    drop(spool);
    let length = fs::metadata(&files[1]).unwrap().len();
    fs::write(&files[1], vec![0; usize::try_from(length).unwrap()]).unwrap();
    let mut spool = open_small(&folder);
    assert_eq!(spool.recovery().damaged_bytes, length);
    let found = sequences(&mut spool);
    assert!(found.first() == Some(&1) && found.last() == Some(&sequence), "{found:?}");
}

fn open_small(folder: &TempDir) -> Spool {
    Spool::open(&options(folder, SpoolOptions::MIN_BYTES), &start()).unwrap()
}

/// Fills a spool; says how many frames it took.
fn fill(spool: &mut Spool, from: u64) -> u64 {
    for sequence in from.. {
        match spool.append(&frame(sequence, 40)) {
            Ok(()) => {}
            Err(SpoolError::Full { bytes, max_bytes, .. }) => {
                assert!(bytes <= max_bytes && max_bytes == SpoolOptions::MIN_BYTES);
                return sequence - from;
            }
            Err(error) => panic!("{error}"),
        }
    }
    unreachable!()
}

fn bytes_on_disk(spool: &Spool) -> u64 {
    segment_files(spool).iter().map(|file| fs::metadata(file).unwrap().len()).sum()
}

#[test]
fn a_full_spool_says_so_keeps_its_bound_and_takes_more_once_frames_are_acked() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open_small(&folder);
    let taken = fill(&mut spool, 1);
    assert!(taken > 40, "{taken} frames of 1 KB in 64 KiB");
    assert!(bytes_on_disk(&spool) <= SpoolOptions::MIN_BYTES);
    assert_eq!(sequences(&mut spool), (1..=taken).collect::<Vec<_>>());

    assert_eq!(spool.forget_up_to(taken / 2).unwrap() as u64, taken / 2);
    let more = fill(&mut spool, taken + 1);
    assert!(more > taken / 4, "{more} after {taken}");
    assert!(bytes_on_disk(&spool) <= SpoolOptions::MIN_BYTES);

    // All is acked: all but one segment's opening is free again, even where the newest segment holds everything.
    spool.forget_up_to(u64::MAX).unwrap();
    let after = fill(&mut spool, 10_000);
    assert!(after + 8 >= taken, "{after} after {taken}");
}

#[test]
fn the_drives_of_one_spool_share_its_bound() {
    let folder = tempfile::tempdir().unwrap();
    let alone = fill(&mut open_small(&folder), 1);
    let second = v1::SessionStart { drive_id: "second".into(), ..start() };
    let mut second = Spool::open(&options(&folder, SpoolOptions::MIN_BYTES), &second);
    // The first drive has left no room for a single frame.
    let spool = second.as_mut().unwrap();
    assert!(matches!(spool.append(&frame(1, 40)), Err(SpoolError::TooLarge { .. } | SpoolError::Full { .. })));
    drop(second);
    let listed = SpooledDrive::list(folder.path()).unwrap();
    assert_eq!(listed.iter().map(|drive| drive.start.drive_id.as_str()).collect::<Vec<_>>(), ["drive", "second"]);
    assert_eq!((listed[0].frames as u64, listed[1].frames, listed[0].ended), (alone, 0, false));
}

#[test]
fn a_frame_larger_than_the_whole_spool_is_refused_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let error = open_small(&folder).append(&frame(7, 3000)).unwrap_err();
    assert!(matches!(error, SpoolError::TooLarge { sequence: 7, max_bytes: SpoolOptions::MIN_BYTES, .. }), "{error}");
}

#[test]
fn numbers_given_are_remembered_when_all_frames_are_acked() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open_small(&folder);
    let taken = fill(&mut spool, 1);
    spool.forget_up_to(taken).unwrap();
    drop(spool);
    let mut spool = open_small(&folder);
    assert_eq!(spool.last_sequence(), Some(taken));
    // What the newest segment holds is acked, and known to be only by the service.
    spool.forget_up_to(taken).unwrap();
    assert_eq!(spool.len(), 0);
    spool.append_end().unwrap();
    drop(spool);
    assert!(open_small(&folder).ended());
}

#[test]
fn a_refused_frame_is_forgotten_and_the_others_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open(&folder);
    for sequence in 1..=4 {
        spool.append(&frame(sequence, 1)).unwrap();
    }
    assert!(spool.forget(2, 3).unwrap());
    assert!(!spool.forget(4, 2).unwrap(), "the fourth was not sent");
    assert_eq!(sequences(&mut spool), [1, 3, 4]);
}

#[test]
fn a_second_process_on_the_same_drive_is_kept_out() {
    let folder = tempfile::tempdir().unwrap();
    let first = open(&folder);
    assert!(matches!(Spool::open(&options(&folder, 1 << 20), &start()), Err(SpoolError::InUse(_))));
    drop(first);
    open(&folder);
}

#[test]
fn a_delivered_drive_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let mut spool = open(&folder);
    spool.append(&frame(1, 1)).unwrap();
    spool.remove().unwrap();
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn a_bound_that_holds_nothing_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let error = Spool::open(&options(&folder, 1000), &start()).unwrap_err();
    assert_eq!(error, SpoolError::Bound { max_bytes: 1000 });
}

/// What a vehicle and a service do to a spool.
#[derive(Clone, Debug)]
enum Step {
    Append {
        points: usize,
    },
    Ack {
        upto: u64,
    },
    Refuse {
        index: usize,
    },
    /// The process is killed, and another begins; its last record may be torn.
    Restart {
        torn_bytes: usize,
    },
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        6 => (0..120usize).prop_map(|points| Step::Append { points }),
        2 => (0..80u64).prop_map(|upto| Step::Ack { upto }),
        1 => (0..8usize).prop_map(|index| Step::Refuse { index }),
        1 => (0..40usize).prop_map(|torn_bytes| Step::Restart { torn_bytes }),
    ];
    prop::collection::vec(step, 1..120)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Against a list in memory: what was taken and not acked or refused is there, in order, through any restart.
    #[test]
    fn nothing_taken_is_lost_and_nothing_else_is_found(steps in steps()) {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = open_small(&folder);
        let mut expected: Vec<u64> = Vec::new();
        // After a restart the acks of the segments that are left are unknown again.
        let mut acked = 0;
        let mut refused: Vec<u64> = Vec::new();
        let mut next = 1;
        for step in steps {
            match step {
                Step::Append { points } => match spool.append(&frame(next, points)) {
                    Ok(()) => {
                        expected.push(next);
                        next += 1;
                    }
                    Err(error) => prop_assert!(matches!(error, SpoolError::Full { .. }), "{error}"),
                },
                Step::Ack { upto } => {
                    acked = acked.max(upto.min(next - 1));
                    spool.forget_up_to(acked).unwrap();
                    expected.retain(|&sequence| sequence > acked);
                }
                Step::Refuse { index } => {
                    if let Some(&sequence) = expected.get(index) {
                        prop_assert!(spool.forget(sequence, usize::MAX).unwrap());
                        expected.remove(index);
                        refused.push(sequence);
                    }
                }
                Step::Restart { torn_bytes } => {
                    let newest = segment_files(&spool).pop().unwrap();
                    drop(spool);
                    let torn = record::encode(Kind::Frame, &[7; 60]).unwrap();
                    let mut bytes = fs::read(&newest).unwrap();
                    bytes.extend_from_slice(&torn[..torn_bytes]);
                    fs::write(&newest, bytes).unwrap();
                    spool = open_small(&folder);
                    prop_assert_eq!(spool.recovery().torn_bytes, torn_bytes as u64);
                    prop_assert_eq!(spool.recovery().damaged_bytes, 0);
                    spool.forget_up_to(acked).unwrap();
                    for &sequence in &refused {
                        spool.forget(sequence, usize::MAX).unwrap();
                    }
                }
            }
            prop_assert_eq!(sequences(&mut spool), expected.clone());
            prop_assert!(bytes_on_disk(&spool) <= SpoolOptions::MIN_BYTES);
            prop_assert_eq!(spool.bytes(), bytes_on_disk(&spool));
            prop_assert_eq!(spool.last_sequence(), (next > 1).then_some(next - 1));
        }
    }
}
