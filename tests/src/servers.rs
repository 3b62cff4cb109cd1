//! Servers on free ports.

use std::{
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
};

use lanemap_proto::v1::{self, map_service_client::MapServiceClient};
use lanemap_server::{RunningServer, Server, ServerConfig};
use prost::Message;

/// Settings for a server of its own: any free port, the store in `folder`, everything else as users get it.
#[must_use]
pub fn config(folder: &Path) -> ServerConfig {
    ServerConfig { listen: ([127, 0, 0, 1], 0).into(), data_dir: folder.to_owned(), ..ServerConfig::default() }
}

/// A server in this process.
pub async fn start(folder: &Path) -> RunningServer {
    Server::start(config(folder)).await.unwrap()
}

/// A server in this process whose map changes often.
pub async fn lively(folder: &Path, change: impl FnOnce(&mut ServerConfig)) -> RunningServer {
    let mut config = ServerConfig { fuse_interval_ms: 20, ..config(folder) };
    change(&mut config);
    Server::start(config).await.unwrap()
}

/// The bytes of a session's map, as `MapService` gives it.
pub async fn map_bytes(url: &str, session: &str) -> Vec<u8> {
    let mut client = MapServiceClient::connect(url.to_owned()).await.unwrap();
    let request = v1::GetLaneMapRequest { session_id: session.to_owned() };
    client.get_lane_map(request).await.unwrap().into_inner().map.unwrap().encode_to_vec()
}

/// A server in a process of its own, which can be killed as no server in this process can.
#[derive(Debug)]
pub struct ServerProcess {
    child: Child,
    /// Where it listens, e.g. `http://127.0.0.1:41234`.
    pub url: String,
}

impl ServerProcess {
    /// Starts `killable-server`, whose path is `binary`, on the store in `folder`, and waits until it listens.
    #[must_use]
    pub fn start(binary: &str, folder: &Path) -> Self {
        Self::spawn(Command::new(binary).arg(folder)).listening()
    }

    /// The same, on a disk of its own in memory that holds `disk_bytes`; what is on it goes with the process. `None` where
    /// this machine lets no user mount one.
    #[must_use]
    pub fn start_on_small_disk(
        binary: &str,
        folder: &Path,
        disk_bytes: u64,
        settings: &[(&str, String)],
    ) -> Option<Self> {
        let mount = format!("mount -t tmpfs -o size={disk_bytes} tmpfs \"$1\"");
        let unshare = || {
            let mut command = Command::new("unshare");
            command.args(["--user", "--map-root-user", "--mount", "sh", "-c"]);
            command
        };
        let possible = unshare().args([&mount, "sh"]).arg(folder).stderr(Stdio::null()).status();
        if !possible.is_ok_and(|status| status.success()) {
            return None;
        }
        let serve = format!("{mount} && exec \"$0\" \"$@\"");
        // What the command is given follows the program: the folder is both the disk's place and its first argument.
        let settings = settings.iter().map(|(name, value)| (*name, value.as_str()));
        Some(Self::spawn(unshare().arg(serve).arg(binary).arg(folder).envs(settings)).listening())
    }

    /// Starts a server and does not wait.
    #[must_use]
    pub fn spawn(command: &mut Command) -> Self {
        let child = command.arg("127.0.0.1:0").stdout(Stdio::piped()).spawn().unwrap();
        Self { child, url: String::new() }
    }

    /// Waits until it listens.
    #[must_use]
    pub fn listening(mut self) -> Self {
        BufReader::new(self.child.stdout.take().unwrap()).read_line(&mut self.url).unwrap();
        assert!(self.url.starts_with("http://"), "the server says {:?}", self.url);
        self.url.truncate(self.url.trim_end().len());
        self
    }

    /// Number of the process.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// A folder as the process sees it, e.g. on a disk that it alone has.
    #[must_use]
    pub fn path_within(&self, folder: &Path) -> PathBuf {
        let root = PathBuf::from(format!("/proc/{}/root", self.id()));
        root.join(folder.strip_prefix("/").unwrap())
    }

    /// `kill -9`.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // It may have been killed before.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
