//! The Python client, as a process of its own.

use std::{
    env,
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
};

use lanemap_proto::{encode, v1};
use prost::Message;
use tokio::sync::mpsc;

use crate::drives::Drive;

/// A drive that a Python client streams.
#[derive(Debug)]
pub struct PythonClient {
    child: Child,
    lines: mpsc::UnboundedReceiver<String>,
}

/// What a Python client is told.
#[derive(Clone, Debug)]
pub struct PythonRun<'a> {
    /// Where the service is: `http://`, `https://`, `tcp/` or `tls/`.
    pub url: &'a str,
    /// The drive's file, as [`write_drive`] makes it.
    pub drive: &'a Path,
    /// Folder of the spool.
    pub spool: &'a Path,
    /// More options of `tests/python/stream_recorded.py`.
    pub options: &'a [String],
}

/// Writes a drive where a Python client finds it.
pub fn write_drive(drive: &Drive, folder: &Path) -> PathBuf {
    let frames = drive.frames.iter().map(encode::frame).collect();
    let message = v1::UploadObservationsRequest { start: Some(drive.wire_start()), frames, end: true };
    let path = folder.join(format!("{}.pb", drive.name));
    std::fs::write(&path, message.encode_to_vec()).unwrap();
    path
}

impl PythonClient {
    /// Starts a client.
    #[must_use]
    pub fn start(run: &PythonRun<'_>) -> Self {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/stream_recorded.py");
        let mut child = Command::new(interpreter())
            .arg(script)
            .arg(run.url)
            .arg(run.drive)
            .arg(run.spool)
            .args(run.options)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let printed = BufReader::new(child.stdout.take().unwrap()).lines();
        let (line, lines) = mpsc::unbounded_channel();
        thread::spawn(move || printed.map_while(Result::ok).try_for_each(|text| line.send(text)));
        Self { child, lines }
    }

    /// The next line that it prints.
    pub async fn line(&mut self) -> Option<String> {
        self.lines.recv().await
    }

    /// Waits until it has ended well; the last line that it printed.
    pub async fn finish(mut self) -> String {
        let mut last = String::new();
        while let Some(line) = self.line().await {
            last = line;
        }
        // It prints no more, so it is about to end.
        let status = self.child.wait().unwrap();
        assert!(status.success(), "the Python client ended with {status}; its last line: {last}");
        last
    }

    /// `kill -9`.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for PythonClient {
    fn drop(&mut self) {
        // It may have ended before.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The Python that has the package `lanemap`: that of `PYTHON_WITH_LANEMAP`, else that of the virtual environment which
/// `tests/run` makes in the target folder.
fn interpreter() -> PathBuf {
    if let Some(named) = env::var_os("PYTHON_WITH_LANEMAP") {
        return named.into();
    }
    let test = env::current_exe().unwrap();
    let target = test.ancestors().find(|folder| folder.join("CACHEDIR.TAG").exists());
    let venv = target.map(|target| target.join("venv/bin/python")).filter(|python| python.exists());
    venv.expect(
        "no Python client: run `python3 -m venv target/venv && target/venv/bin/pip install ./clients/python`, \
         or name a Python that has it in PYTHON_WITH_LANEMAP",
    )
}
