//! The folders of a spool: one for each drive that is not wholly delivered.

use std::{
    fmt::Write as _,
    fs, io,
    path::{Path, PathBuf},
};

use lanemap_proto::{v1, zenoh_keys::encode_id};
use prost::Message;
use sha2::{Digest, Sha256};

use super::{
    SpoolError, disk,
    record::Kind,
    segment::{self, Found},
};

/// Longest name of a folder that is an encoded id; a longer id is named by its hash. File systems allow 255.
const MAX_NAME_BYTES: usize = 200;

/// A drive of which a spool still holds something.
#[derive(Clone, Debug, PartialEq)]
pub struct SpooledDrive {
    /// The drive, as its session was started.
    pub start: v1::SessionStart,
    /// Frames neither acked nor refused when their segments were last written; some may be durable by now.
    pub frames: usize,
    /// Bytes on disk.
    pub bytes: u64,
    /// Whether the drive was ended.
    pub ended: bool,
}

impl SpooledDrive {
    /// The drives of a spool's folder, in the order of their ids. Nothing is changed, whoever uses them now.
    ///
    /// # Errors
    /// A folder that cannot be read; one that does not exist holds no drive.
    pub fn list(spool: &Path) -> Result<Vec<Self>, SpoolError> {
        let mut drives = Vec::new();
        for folder in drive_folders(spool).map_err(|error| disk(spool, &error))? {
            drives.extend(Self::read(&folder).map_err(|error| disk(&folder, &error))?);
        }
        let key = |drive: &Self| {
            let v1::SessionStart { fleet_id, vehicle_id, drive_id, .. } = &drive.start;
            (fleet_id.clone(), vehicle_id.clone(), drive_id.clone())
        };
        drives.sort_by_key(key);
        Ok(drives)
    }

    fn read(folder: &Path) -> io::Result<Option<Self>> {
        let (mut start, mut frames, mut bytes, mut ended) = (None, 0, 0, false);
        for number in segment::numbers(folder)? {
            let segment = fs::read(folder.join(segment::file_name(number)))?;
            bytes += segment.len() as u64;
            for Found { kind, body, .. } in segment::read_records(&segment).records {
                match kind {
                    Kind::Start => start = v1::SessionStart::decode(body.as_slice()).ok().or(start),
                    Kind::Frame => frames += 1,
                    Kind::End => ended = true,
                    Kind::Mark => {}
                }
            }
        }
        Ok(start.map(|start| Self { start, frames, bytes, ended }))
    }
}

/// The folder of a drive.
pub(super) fn of_drive(spool: &Path, start: &v1::SessionStart) -> PathBuf {
    let v1::SessionStart { fleet_id, vehicle_id, drive_id, .. } = start;
    [fleet_id, vehicle_id, drive_id].into_iter().fold(spool.to_owned(), |folder, id| folder.join(name(id)))
}

/// Bytes of all drives but one.
pub(super) fn other_bytes(spool: &Path, but: &Path) -> io::Result<u64> {
    let mut bytes = 0;
    for folder in drive_folders(spool)? {
        if folder != but {
            for number in segment::numbers(&folder)? {
                bytes += length(&folder.join(segment::file_name(number)))?;
            }
        }
    }
    Ok(bytes)
}

/// Deletes a drive's folder, and those around it that are empty then.
pub(super) fn remove(folder: &Path) -> io::Result<()> {
    fs::remove_dir_all(folder)?;
    for around in folder.ancestors().skip(1).take(2) {
        // Another drive of the vehicle or of the fleet.
        if fs::remove_dir(around).is_err() {
            break;
        }
    }
    Ok(())
}

/// The folders three levels down.
fn drive_folders(spool: &Path) -> io::Result<Vec<PathBuf>> {
    let mut folders = vec![spool.to_owned()];
    for _ in ["fleet", "vehicle", "drive"] {
        let mut below = Vec::new();
        for folder in folders {
            below.extend(subfolders(&folder)?);
        }
        folders = below;
    }
    Ok(folders)
}

fn subfolders(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        // Nothing was spooled yet, or another process has just delivered the last of it.
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error),
    };
    let mut found = Vec::new();
    for entry in entries {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            found.push(entry.path());
        }
    }
    found.sort();
    Ok(found)
}

fn length(file: &Path) -> io::Result<u64> {
    match fs::metadata(file) {
        Ok(metadata) => Ok(metadata.len()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(0),
        Err(error) => Err(error),
    }
}

/// Name of an id's folder: encoded as in a key of zenoh, a dot at the beginning too, so that no id leads out of the spool.
fn name(id: &str) -> String {
    let encoded = encode_id(id);
    let name = match encoded.strip_prefix('.') {
        Some(rest) => format!("%2E{rest}"),
        None => encoded,
    };
    if name.len() <= MAX_NAME_BYTES {
        return name;
    }
    let hash = Sha256::digest(id.as_bytes());
    hash.iter().fold("%sha256-".to_owned(), |mut name, byte| {
        // A string takes whatever is written to it.
        let _ = write!(name, "{byte:02x}");
        name
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_that_is_a_path_stays_within_the_spool() {
        assert_eq!(name(".."), "%2E.");
        assert_eq!(name("../../etc/passwd"), "%2E.%2F..%2Fetc%2Fpasswd");
        assert_eq!(name("Wagen 7.ü"), "Wagen%207.%C3%BC");
    }

    #[test]
    fn an_id_of_128_characters_of_any_script_has_a_name_that_file_systems_take() {
        let (one, other) = ("道".repeat(128), format!("{}路", "道".repeat(127)));
        assert!(name(&one).len() <= MAX_NAME_BYTES);
        assert_ne!(name(&one), name(&other));
    }
}
