//! Servers on free ports.

use std::{
    io::{BufRead, BufReader},
    path::Path,
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
        let mut child = Command::new(binary).arg(folder).arg("127.0.0.1:0").stdout(Stdio::piped()).spawn().unwrap();
        let mut url = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut url).unwrap();
        assert!(url.starts_with("http://"), "the server says {url:?}");
        Self { child, url: url.trim().to_owned() }
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
