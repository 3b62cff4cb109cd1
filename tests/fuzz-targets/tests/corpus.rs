//! The committed corpus, as ordinary tests: no target may panic on what was once worth keeping.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a test fails where it fails

use std::{
    fs,
    path::{Path, PathBuf},
};

use lanemap_fuzz_targets::TARGETS;

fn corpus(target: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus").join(target);
    let mut files: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(!files.is_empty(), "{} is empty", folder.display());
    files
}

#[test]
fn every_target_takes_its_corpus() {
    for (name, target) in TARGETS {
        for file in corpus(name) {
            let bytes = fs::read(&file).unwrap();
            let outcome = std::panic::catch_unwind(|| target(&bytes));
            assert!(outcome.is_ok(), "{} fails", file.display());
        }
    }
}

#[test]
fn every_target_takes_what_its_corpus_becomes_when_it_is_cut_or_damaged() {
    for (name, target) in TARGETS {
        for file in corpus(name).into_iter().take(12) {
            let whole = fs::read(&file).unwrap();
            for part in 0..16 {
                let at = whole.len() * part / 16;
                target(&whole[..at]);
                let mut damaged = whole.clone();
                if let Some(byte) = damaged.get_mut(at) {
                    *byte ^= 0xff;
                    target(&damaged);
                }
            }
        }
    }
}
