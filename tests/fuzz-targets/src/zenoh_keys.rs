//! Keys and attachments of zenoh, which anybody on the network can choose.

use lanemap_proto::zenoh_keys::{Attachment, VehicleKey, VehicleKeys, decode_id, encode_id};

/// Parses `bytes` as a key, as an id within one, and as an attachment; what parses is written again as it was.
pub fn zenoh_keys(bytes: &[u8]) {
    if let Ok(attachment) = Attachment::parse(bytes) {
        assert_eq!(attachment.to_string().as_bytes(), bytes);
    }
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    if let Ok(key) = VehicleKey::parse(text) {
        let keys = VehicleKeys::new(&key.fleet, &key.vehicle);
        let root = keys.observations();
        let root = root.strip_suffix("observations").expect("it ends so");
        assert_eq!(format!("{root}{}", key.rest), text, "one vehicle has one key");
        let _ = key.alive_nonce();
    }
    let chunk = encode_id(text);
    assert!(!chunk.contains(['/', '*', '$', '#', '?', '@']), "an id leads out of its chunk: {chunk}");
    if !text.is_empty() {
        assert_eq!(decode_id(&chunk).as_deref(), Some(text));
    }
}
