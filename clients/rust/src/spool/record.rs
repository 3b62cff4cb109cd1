//! One record of a segment file, and how a damaged one is told from one that was torn off.
//!
//! ```text
//! segment = "lmspool1" record*
//! record  = marker:[u8; 4] length:u32 crc:u32 kind:u8 body:[u8; length]        little-endian
//! crc     = CRC-32 (IEEE, as in zlib) of length, kind and body
//! ```
//!
//! After damage, whatever it was, a reader goes on at the next marker that begins a whole record.

/// First bytes of every segment file: what it is, and which version of the format.
pub(crate) const MAGIC: &[u8; 8] = b"lmspool1";
/// First bytes of every record.
pub(crate) const MARKER: &[u8; 4] = b"\xf5lmr";
/// Bytes of a record before its body.
pub(crate) const HEADER_BYTES: usize = 13;

/// What a record holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// `lanemap.v1.SessionStart`: the drive, so that a spool can be delivered by who knows nothing of it.
    Start,
    /// `u64`, little-endian: the highest sequence spooled before this segment, so that numbers are not given twice.
    Mark,
    /// `lanemap.v1.Frame`.
    Frame,
    /// No body: the drive is over.
    End,
}

/// Why the bytes at some place are not a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NotARecord {
    /// The file ends before the record does: its writer was cut off.
    Torn,
    /// The bytes are not those that were written.
    Damaged,
}

impl Kind {
    fn code(self) -> u8 {
        match self {
            Self::Start => 1,
            Self::Mark => 2,
            Self::Frame => 3,
            Self::End => 4,
        }
    }

    fn of(code: u8) -> Option<Self> {
        [Self::Start, Self::Mark, Self::Frame, Self::End].into_iter().find(|kind| kind.code() == code)
    }
}

/// The bytes of a record; `None` where the body is longer than 4 GiB.
pub(crate) fn encode(kind: Kind, body: &[u8]) -> Option<Vec<u8>> {
    let length = u32::try_from(body.len()).ok()?.to_le_bytes();
    let mut record = Vec::with_capacity(HEADER_BYTES + body.len());
    record.extend_from_slice(MARKER);
    record.extend_from_slice(&length);
    record.extend_from_slice(&checksum(length, kind.code(), body).to_le_bytes());
    record.push(kind.code());
    record.extend_from_slice(body);
    Some(record)
}

/// The record at the beginning of `bytes`: its kind and its body.
pub(crate) fn decode(bytes: &[u8]) -> Result<(Kind, &[u8]), NotARecord> {
    let Some((header, rest)) = bytes.split_first_chunk::<HEADER_BYTES>() else {
        let begins = bytes.iter().zip(MARKER).all(|(byte, marker)| byte == marker);
        return Err(if begins { NotARecord::Torn } else { NotARecord::Damaged });
    };
    let [m0, m1, m2, m3, l0, l1, l2, l3, c0, c1, c2, c3, code] = *header;
    if [m0, m1, m2, m3] != *MARKER {
        return Err(NotARecord::Damaged);
    }
    let length = [l0, l1, l2, l3];
    let crc = u32::from_le_bytes([c0, c1, c2, c3]);
    let body_bytes = u32::from_le_bytes(length) as usize;
    let body = rest.get(..body_bytes).ok_or(NotARecord::Torn)?;
    match Kind::of(code) {
        Some(kind) if checksum(length, code, body) == crc => Ok((kind, body)),
        _ => Err(NotARecord::Damaged),
    }
}

/// Where the next whole record begins, from the second of `bytes` on.
pub(crate) fn next_record(bytes: &[u8]) -> Option<usize> {
    let starts = bytes.windows(MARKER.len()).enumerate().skip(1).filter(|(_, window)| window == MARKER);
    starts.map(|(at, _)| at).find(|&at| decode(&bytes[at..]).is_ok())
}

fn checksum(length: [u8; 4], code: u8, body: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&length);
    hasher.update(&[code]);
    hasher.update(body);
    hasher.finalize()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_record_has_the_bytes_that_the_python_client_writes() {
        // The same bytes stand in clients/python/tests/test_spool.py.
        let record = encode(Kind::Mark, &7u64.to_le_bytes()).unwrap();
        assert_eq!(record, *b"\xf5lmr\x08\0\0\0\x70\xb4\x44\x71\x02\x07\0\0\0\0\0\0\0");
    }

    proptest! {
        #[test]
        fn what_was_written_is_read(body in prop::collection::vec(any::<u8>(), 0..300), rest in prop::collection::vec(any::<u8>(), 0..20)) {
            let mut bytes = encode(Kind::Frame, &body).unwrap();
            bytes.extend_from_slice(&rest);
            prop_assert_eq!(decode(&bytes), Ok((Kind::Frame, body.as_slice())));
        }

        #[test]
        fn a_record_cut_short_anywhere_is_torn(body in prop::collection::vec(any::<u8>(), 0..300), cut in any::<prop::sample::Index>()) {
            let bytes = encode(Kind::Frame, &body).unwrap();
            prop_assert_eq!(decode(&bytes[..cut.index(bytes.len())]), Err(NotARecord::Torn));
        }

        #[test]
        fn a_flipped_bit_anywhere_is_never_taken_for_a_record(
            body in prop::collection::vec(any::<u8>(), 0..300),
            at in any::<prop::sample::Index>(),
            bit in 0..8u8,
        ) {
            let mut bytes = encode(Kind::Frame, &body).unwrap();
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
            prop_assert!(decode(&bytes).is_err());
        }

        #[test]
        fn any_bytes_at_all_are_read_without_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..100)) {
            let _ = decode(&bytes);
        }
    }
}
