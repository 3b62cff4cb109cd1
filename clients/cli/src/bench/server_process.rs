//! A server in a process of its own: this very command, started for the length of a benchmark.

use std::{
    fs,
    io::{BufRead, BufReader},
    net::Ipv4Addr,
    process::{Child, Command, Stdio},
};

use anyhow::Context;
use tempfile::TempDir;
use tokio::net::TcpSocket;

/// A process that serves until this is dropped, and the folder that it writes into.
#[derive(Debug)]
pub struct ServerProcess {
    child: Child,
    /// Where it listens.
    pub url: String,
    _folder: TempDir,
}

impl ServerProcess {
    /// `lanemap serve` on a free port, its store in a temporary folder, everything else as the environment says. With an
    /// endpoint of zenoh, it is a router there too.
    pub fn serve(zenoh: Option<&str>) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir().context("no temporary folder")?;
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["serve", "--listen", "127.0.0.1:0", "--data-dir"]).arg(folder.path());
        if let Some(endpoint) = zenoh {
            command.args(["--zenoh-mode", "router", "--zenoh-listen", endpoint]);
        }
        Self::start(command, folder)
    }

    /// `lanemap bench echo-server`.
    pub fn echo() -> anyhow::Result<Self> {
        let folder = tempfile::tempdir().context("no temporary folder")?;
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["bench", "echo-server"]);
        Self::start(command, folder)
    }

    fn start(mut command: Command, folder: TempDir) -> anyhow::Result<Self> {
        let mut child = command.stdout(Stdio::piped()).spawn().context("the server cannot be started")?;
        let mut said = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut said)?;
        }
        let address = said.split_whitespace().find(|word| word.starts_with("http://"));
        let url = address.with_context(|| format!("the server did not say where it listens, but {said:?}"))?;
        Ok(Self { url: url.trim_end_matches(',').to_owned(), child, _folder: folder })
    }

    /// Memory that the process holds, MB.
    pub fn rss_mb(&self) -> anyhow::Result<f64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let kib = resident.and_then(|text| text.split_whitespace().next()).context("/proc has no VmRSS")?;
        Ok(kib.parse::<f64>()? * 1024.0 / 1e6)
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // Its folder goes with it: nothing needs to be saved. It may have ended before.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// An endpoint of zenoh on this machine at which nobody listens, and what keeps its port from others meanwhile: a socket
/// that is bound and does not listen, beside which the server may.
pub fn free_zenoh_endpoint() -> anyhow::Result<(String, TcpSocket)> {
    let held = TcpSocket::new_v4()?;
    held.set_reuseaddr(true)?;
    held.bind((Ipv4Addr::LOCALHOST, 0).into())?;
    Ok((format!("tcp/{}", held.local_addr()?), held))
}

/// What a server answers at an address.
pub async fn text(url: &str) -> anyhow::Result<String> {
    // Somebody in the process must name the cryptography that reqwest does not bring.
    let _ = rustls::crypto::ring::default_provider().install_default();
    Ok(reqwest::get(url).await?.error_for_status()?.text().await?)
}

/// Memory that the process of a server elsewhere holds, MB, as its metrics say.
pub async fn rss_mb_by_metrics(url: &str) -> anyhow::Result<f64> {
    let url = format!("{}/metrics", url.trim_end_matches('/'));
    let metrics = text(&url).await?;
    let resident = metrics.lines().find_map(|line| line.strip_prefix("process_resident_memory_bytes "));
    let bytes = resident.with_context(|| format!("{url} has no process_resident_memory_bytes"))?;
    Ok(bytes.trim().parse::<f64>()? / 1e6)
}
