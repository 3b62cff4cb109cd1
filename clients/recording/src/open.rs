//! Finds the drives of a path, by content and not by name.

use std::{
    fs::{self, File},
    io::{BufReader, Read, Seek, SeekFrom},
    path::{Path, PathBuf},
};

use lanemap_openlane::{Drives, OpenLaneError};

use crate::{
    bag::BagDrive,
    drive::{ReadOptions, RecordedDrive},
    error::RecordingError,
    mcap::McapDrive,
};

/// Bytes that tell what a file is.
const MAGIC_BYTES: u64 = 16;

/// What a file is, by its first bytes.
enum Kind {
    Mcap,
    Bag,
    Other(String),
}

/// The drives at `path`, in the order of their names: those of a folder of `segment-*` folders, MCAP files and bags, or
/// the one of a file.
///
/// # Errors
/// A path that cannot be read or holds no drive, a file that is no recording, or a text of `options.only` that no
/// drive's name contains.
pub fn open(path: impl AsRef<Path>, options: &ReadOptions) -> Result<Vec<RecordedDrive>, RecordingError> {
    let path = path.as_ref();
    let metadata = fs::metadata(path).map_err(|source| RecordingError::io(path, source))?;
    let mut drives = if metadata.is_dir() { drives_of_folder(path, options)? } else { vec![open_file(path, options)?] };
    if drives.is_empty() {
        return Err(RecordingError::Empty { path: path.to_owned() });
    }
    let contains = |drive: &RecordedDrive, text: &String| drive.name().contains(text.as_str());
    if let Some(name) = options.only.iter().find(|text| !drives.iter().any(|drive| contains(drive, text))) {
        return Err(RecordingError::NoSuchDrive { path: path.to_owned(), name: name.clone() });
    }
    if !options.only.is_empty() {
        drives.retain(|drive| options.only.iter().any(|text| contains(drive, text)));
    }
    drives.sort_by(|a, b| a.name().cmp(b.name()));
    Ok(drives)
}

fn drives_of_folder(folder: &Path, options: &ReadOptions) -> Result<Vec<RecordedDrive>, RecordingError> {
    let mut drives: Vec<_> = Drives::list(folder, &[])?.into_iter().map(RecordedDrive::OpenLane).collect();
    let io = |source| RecordingError::io(folder, source);
    let entries = fs::read_dir(folder).map_err(io)?.map(|entry| entry.map(|entry| entry.path()).map_err(io));
    let mut files = entries.collect::<Result<Vec<PathBuf>, _>>()?;
    files.retain(|file| file.extension().is_some_and(|ending| ending == "mcap" || ending == "bag") && file.is_file());
    files.sort_unstable();
    for file in files {
        drives.push(open_file(&file, options)?);
    }
    Ok(drives)
}

fn open_file(path: &Path, options: &ReadOptions) -> Result<RecordedDrive, RecordingError> {
    let io = |source| RecordingError::io(path, source);
    let mut file = File::open(path).map_err(io)?;
    let mut magic = Vec::new();
    file.by_ref().take(MAGIC_BYTES).read_to_end(&mut magic).map_err(io)?;
    file.seek(SeekFrom::Start(0)).map_err(io)?;
    let input = BufReader::new(file);
    match kind(&magic) {
        Kind::Mcap => Ok(RecordedDrive::Mcap(Box::new(McapDrive::open(path, input)?))),
        Kind::Bag => Ok(RecordedDrive::Bag(Box::new(BagDrive::open(path, input, &options.bag)?))),
        Kind::Other(found) => Err(RecordingError::Unknown { path: path.to_owned(), found }),
    }
}

fn kind(magic: &[u8]) -> Kind {
    let other = |found: &str| Kind::Other(found.to_owned());
    if magic.starts_with(::mcap::MAGIC) {
        Kind::Mcap
    } else if magic.starts_with(crate::bag::MAGIC) {
        Kind::Bag
    } else if magic.starts_with(b"#ROSBAG V1") {
        other("is a ROS bag of version 1, which rosbag migrates to 2.0")
    } else if magic.starts_with(b"SQLite format 3") {
        other("is a SQLite database, perhaps a ROS 2 bag, which `ros2 bag convert` turns into MCAP")
    } else if magic.is_empty() {
        other("is empty")
    } else if magic.len() < ::mcap::MAGIC.len() {
        Kind::Other(format!("has {} bytes only", magic.len()))
    } else {
        Kind::Other(format!("begins with {:02x?}", &magic[..::mcap::MAGIC.len()]))
    }
}

/// The camera of an OpenLane annotation, or of the first frame of the drive `name` of a folder of drives.
pub(crate) fn camera_of(path: &Path, name: &str) -> Result<lanemap_openlane::Annotation, RecordingError> {
    if !path.is_dir() {
        return Ok(lanemap_openlane::Annotation::read(path)?);
    }
    let drive = lanemap_openlane::DriveFolder::open(path, name)?;
    let Some(first) = drive.times().first() else {
        return Err(OpenLaneError::NoSuchDrive { root: path.to_owned(), name: name.to_owned() }.into());
    };
    Ok(drive.annotation(*first)?)
}
