//! Descriptors as schemas: just what a message is made of, without the comments of its files.

use std::collections::BTreeSet;

use prost::Message;
use prost_types::{FileDescriptorProto, FileDescriptorSet};

/// The files of `set` that the message `name` (with its package) needs, each after those that it imports; all of the set
/// where the message is not in it.
pub(super) fn schema_of(name: &str, set: &[u8]) -> Vec<u8> {
    let Ok(FileDescriptorSet { file: files }) = FileDescriptorSet::decode(set) else { return set.to_owned() };
    let Some(home) = files.iter().find(|file| defines(file, name)) else { return set.to_owned() };
    let mut needed = BTreeSet::new();
    let mut open = vec![home.name()];
    while let Some(file) = open.pop() {
        if needed.insert(file.to_owned()) {
            let imported = files.iter().filter(|other| other.name() == file).flat_map(|file| &file.dependency);
            open.extend(imported.map(String::as_str));
        }
    }
    let file = files.iter().filter(|file| needed.contains(file.name())).cloned();
    let file = file.map(|file| FileDescriptorProto { source_code_info: None, ..file }).collect();
    FileDescriptorSet { file }.encode_to_vec()
}

fn defines(file: &FileDescriptorProto, name: &str) -> bool {
    let message = name.strip_prefix(file.package()).and_then(|rest| rest.strip_prefix('.'));
    message.is_some_and(|message| file.message_type.iter().any(|defined| defined.name() == message))
}

#[cfg(test)]
mod tests {
    use lanemap_proto::v1;

    use super::*;

    #[test]
    fn a_frame_needs_the_files_of_observations_and_of_geometry() {
        let schema = schema_of("lanemap.v1.Frame", v1::FILE_DESCRIPTOR_SET);
        let files = FileDescriptorSet::decode(schema.as_slice()).unwrap().file;
        let names: Vec<_> = files.iter().map(FileDescriptorProto::name).collect();
        assert_eq!(names, ["lanemap/v1/geometry.proto", "lanemap/v1/observation.proto"]);
        assert!(schema.len() < v1::FILE_DESCRIPTOR_SET.len() / 4);
    }
}
