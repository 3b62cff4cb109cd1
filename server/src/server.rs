//! Starts and stops the service.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axum::{Router, middleware};
use lanemap_proto::v1::{
    self, admin_service_server::AdminServiceServer, ingest_service_server::IngestServiceServer,
    map_service_server::MapServiceServer,
};
use thiserror::Error;
use tokio::{
    net::TcpListener,
    sync::watch,
    task::JoinHandle,
    time::{sleep, timeout},
};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tonic::{codec::CompressionEncoding, server::NamedService, service::Routes};
use tonic_health::{ServingStatus, server::HealthReporter};

use crate::{
    admin::AdminGrpc,
    auth::{
        layer::authenticate,
        reload::{CredentialError, Credentials},
    },
    change_feed::ChangeFeeds,
    config::{ConfigError, ServerConfig, ZenohMode},
    fuse::{FuseSettings, FuseThreads, Fuser, SharedMap},
    ingest::{BoundedIngest, IngestGrpc, ZenohError, conversation::Conversations, zenoh::ZenohIngest},
    journal::{CommitterThread, Journal, JournalError, JournalHealth, JournalOptions},
    listener,
    map_service::MapGrpc,
    privacy::{KeyError, Pseudonyms},
    serve::{self, Readiness, ServeState, link_base},
    session::{Sessions, actor::Surroundings, in_flight::InFlightBudget, registry::SessionRegistry},
    telemetry,
};

/// Time between two clean-ups of the metrics' histograms.
const METRICS_UPKEEP: Duration = Duration::from_secs(5);

/// Time between two looks at the room on the disk, where nothing else asks for it.
const PROBE_INTERVAL: Duration = Duration::from_secs(1);

/// Time for the journal's last commit, once every session has left.
const JOURNAL_GRACE: Duration = Duration::from_secs(1);

/// Why the service does not start.
#[derive(Debug, Error)]
pub enum StartError {
    /// A setting is out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A file of certificates or keys cannot be used.
    #[error(transparent)]
    Credentials(#[from] CredentialError),
    /// The store cannot be opened.
    #[error("the store in {folder}: {source}")]
    Journal {
        /// The folder.
        folder: String,
        /// What is wrong with it.
        source: JournalError,
    },
    /// The pseudonyms' key cannot be used.
    #[error(transparent)]
    PrivacyKey(#[from] KeyError),
    /// The address cannot be listened on.
    #[error("listening on {address}: {source}")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What is wrong with it.
        source: std::io::Error,
    },
    /// The zenoh side of ingest does not start.
    #[error(transparent)]
    Zenoh(#[from] ZenohError),
    /// The descriptors for reflection do not read.
    #[error("gRPC reflection: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// The service.
#[derive(Debug)]
pub struct Server;

/// A service that runs. Stop it with [`RunningServer::shutdown`]; dropped, it stops in the background.
#[derive(Debug)]
pub struct RunningServer {
    address: SocketAddr,
    sessions: Sessions,
    map: SharedMap,
    credentials: Credentials,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Server {
    /// Opens the store, reads every session in it, and serves gRPC and HTTP on one port.
    ///
    /// # Errors
    /// A setting out of range, a store that cannot be opened, an address that cannot be listened on.
    pub async fn start(config: ServerConfig) -> Result<RunningServer, StartError> {
        config.check()?;
        let credentials = Credentials::load(&config)?;
        warn_of_exposure(&config);
        let metrics = telemetry::metrics_handle();
        let config = Arc::new(config);
        let in_store = |source| StartError::Journal { folder: config.data_dir.display().to_string(), source };
        let (journal, committer) = Journal::open(&journal_options(&config)).map_err(in_store)?;
        let pseudonyms = pseudonyms(&config, &journal)?;
        let (sessions, stop, shutdown) =
            (Sessions::new(config.max_cached_map_bytes), CancellationToken::new(), CancellationToken::new());
        let map = SharedMap::new(config.max_cached_cell_bytes);
        let fuse_threads = start_fusing(&config, &journal, map.clone()).await.map_err(in_store)?;
        let surroundings = Surroundings {
            config: Arc::clone(&config),
            journal: journal.clone(),
            pseudonyms,
            sessions: sessions.clone(),
            fuser: fuse_threads.fuser(),
            in_flight: InFlightBudget::new(&config),
            shutdown: shutdown.clone(),
        };
        let registry = SessionRegistry::recover(surroundings).await.map_err(in_store)?;

        let listen_error = |source| StartError::Listen { address: config.listen, source };
        let listener = TcpListener::bind(config.listen).await.map_err(listen_error)?;
        let address = listener.local_addr().map_err(listen_error)?;

        let (ready, is_ready) = watch::channel(Readiness::Ready);
        let http = ServeState {
            sessions: sessions.clone(),
            map: map.clone(),
            feeds: ChangeFeeds::new(&config, map.clone(), shutdown.clone()),
            metrics,
            ready: is_ready,
            shutdown: shutdown.clone(),
            config: Arc::clone(&config),
        };
        let streams = TaskTracker::new();
        let conversations =
            Conversations::new(Arc::clone(&config), registry.clone(), shutdown.clone(), streams.clone());
        let (ingest, admin) = (IngestGrpc::new(conversations.clone()), AdminGrpc::new(registry.clone()));
        let (health, router) = router(&config, ingest, admin, http).await?;
        let router = router.layer(middleware::from_fn_with_state(Arc::clone(&credentials.authenticator), authenticate));
        tokio::spawn(registry.clone().keep_erasing());
        tokio::spawn({
            let (registry, fuser) = (registry.clone(), fuse_threads.fuser());
            async move {
                if let Err(error) = registry.wake_unsaved().await {
                    tracing::warn!(%error, "what is told of drives that a crash interrupted is not up to date");
                }
                fuser.begin();
            }
        });
        let zenoh = match config.zenoh_mode {
            ZenohMode::Off => None,
            ZenohMode::Router | ZenohMode::Client => Some(
                ZenohIngest::open(
                    &config,
                    conversations,
                    Arc::clone(&credentials.authenticator),
                    streams.clone(),
                    &map,
                    shutdown.clone(),
                )
                .await?,
            ),
        };

        let running = Running {
            config,
            credentials: credentials.clone(),
            registry,
            map: map.clone(),
            fuse_threads,
            streams,
            zenoh,
            ready,
            health,
            stop: stop.clone(),
            shutdown,
            journal,
            committer,
        };
        metrics::gauge!(telemetry::READY).set(1.0);
        let task = tokio::spawn(running.run(listener, router));
        tracing::info!(%address, "serving gRPC and HTTP");
        Ok(RunningServer { address, sessions, map, credentials, stop, task })
    }
}

impl RunningServer {
    /// Where gRPC and HTTP are served.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The address as a URL, for clients on this machine.
    #[must_use]
    pub fn url(&self) -> String {
        let scheme = if self.credentials.tls.is_some() { "https" } else { "http" };
        format!("{scheme}://{}", self.address)
    }

    /// The certificates and keys in use: a handle to read them anew, e.g. at SIGHUP.
    #[must_use]
    pub fn credentials(&self) -> Credentials {
        self.credentials.clone()
    }

    /// The published maps.
    #[must_use]
    pub fn sessions(&self) -> &Sessions {
        &self.sessions
    }

    /// The shared map.
    #[must_use]
    pub fn map(&self) -> &SharedMap {
        &self.map
    }

    /// Begins a shutdown when cancelled; e.g. from a signal handler.
    #[must_use]
    pub fn shutdown_token(&self) -> CancellationToken {
        self.stop.clone()
    }

    /// Stops: readiness falls, then, `drain_delay_ms` later, streams end with what they were promised, drives are saved,
    /// the port and the store close.
    pub async fn shutdown(self) {
        self.stop.cancel();
        self.stopped().await;
    }

    /// Waits until the service has stopped.
    pub async fn stopped(mut self) {
        if let Err(error) = (&mut self.task).await {
            tracing::error!(%error, "the service did not stop cleanly");
        }
    }
}

impl Drop for RunningServer {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// What a service that runs must stop, in the order in which it stops.
struct Running {
    config: Arc<ServerConfig>,
    credentials: Credentials,
    registry: SessionRegistry,
    map: SharedMap,
    fuse_threads: FuseThreads,
    streams: TaskTracker,
    zenoh: Option<ZenohIngest>,
    ready: watch::Sender<Readiness>,
    health: HealthReporter,
    /// The service is told to stop: readiness falls.
    stop: CancellationToken,
    /// The drain begins: streams and sessions end.
    shutdown: CancellationToken,
    journal: Journal,
    committer: CommitterThread,
}

impl Running {
    async fn tell_readiness(&self, readiness: Readiness) {
        let status = if readiness == Readiness::Ready { ServingStatus::Serving } else { ServingStatus::NotServing };
        metrics::gauge!(telemetry::READY).set(if readiness == Readiness::Ready { 1.0 } else { 0.0 });
        self.ready.send_replace(readiness);
        self.health.set_service_status("", status).await;
        self.health.set_service_status(IngestServiceServer::<IngestGrpc>::NAME, status).await;
    }

    /// Readiness follows the journal's health: maps stay readable while no frame can be made durable.
    async fn watch_journal(&self) {
        let mut health = self.journal.health();
        loop {
            let now = health.borrow_and_update().clone();
            self.tell_readiness(readiness(&now)).await;
            let changed = async {
                loop {
                    tokio::select! {
                        changed = health.changed() => return changed.is_ok(),
                        // A disk that runs full is noticed where nothing is written, too.
                        () = sleep(PROBE_INTERVAL) => { let _ = self.journal.probe().await; }
                    }
                }
            };
            if !changed.await {
                return std::future::pending().await;
            }
        }
    }

    /// Waits for the word to stop; readiness falls at once, the drain begins once balancers have had time to see it.
    async fn stopped(&self) {
        tokio::select! {
            () = self.stop.cancelled() => {}
            () = self.watch_journal() => {}
        }
        tracing::info!("shutting down");
        self.tell_readiness(Readiness::NotReady("shutting down".to_owned())).await;
        self.health.set_not_serving::<MapServiceServer<MapGrpc>>().await;
        sleep(self.config.drain_delay()).await;
        self.shutdown.cancel();
    }

    async fn run(self, listener: TcpListener, router: Router) {
        let stop_listening = CancellationToken::new();
        let grace = self.config.shutdown_grace();
        let overdue = {
            let shutdown = self.shutdown.clone();
            async move {
                shutdown.cancelled().await;
                sleep(grace).await;
            }
        };
        let serving = tokio::spawn({
            let (config, stop, tls) = (Arc::clone(&self.config), stop_listening.clone(), self.credentials.tls.clone());
            async move { listener::serve(listener, router, &config, tls, stop, overdue).await }
        });
        let watching = tokio::spawn(self.credentials.clone().watch(stop_listening.clone()));
        let upkeep = tokio::spawn(async {
            loop {
                sleep(METRICS_UPKEEP).await;
                telemetry::metrics_handle().run_upkeep();
            }
        });
        self.stopped().await;
        self.streams.close();
        let sessions_left = async {
            self.streams.wait().await;
            self.registry.stopped().await;
        };
        if timeout(grace, sessions_left).await.is_err() {
            tracing::warn!("some sessions had not left at the end of the grace time; what they acked is durable");
        }
        if let Some(zenoh) = self.zenoh {
            zenoh.close().await;
        }
        stop_listening.cancel();
        if let Err(error) = serving.await {
            tracing::error!(%error, "the listener failed");
        }
        upkeep.abort();
        watching.abort();
        if timeout(grace, self.fuse_threads.stop()).await.is_err() {
            tracing::warn!("a cell was still being fused at the end of the grace time");
        }
        self.map.let_go_of_store();
        self.registry.let_go_of_store();
        drop(self.registry);
        drop(self.journal);
        if timeout(JOURNAL_GRACE, self.committer.join()).await.is_err() {
            tracing::warn!("the journal was still in use at the end of the grace time");
        }
    }
}

/// Starts the threads that fuse the shared map, which is read from the store.
async fn start_fusing(config: &ServerConfig, journal: &Journal, map: SharedMap) -> Result<FuseThreads, JournalError> {
    let (settings, store) = (FuseSettings::of(config), journal.cells());
    let starting = tokio::task::spawn_blocking(move || Fuser::start(settings, &store, map));
    starting.await.map_err(|error| JournalError::Store(format!("reading the shared map: {error}")))?
}

/// The pseudonyms of the store's drives.
fn pseudonyms(config: &ServerConfig, journal: &Journal) -> Result<Pseudonyms, StartError> {
    let in_store = |source| StartError::Journal { folder: config.data_dir.display().to_string(), source };
    let written_with = journal.key_fingerprint().map_err(in_store)?;
    let pseudonyms = Pseudonyms::open(&config.privacy_key_path(), written_with)?;
    if written_with.is_none() {
        journal.adopt_key(&pseudonyms).map_err(in_store)?;
    }
    Ok(pseudonyms)
}

/// Says in the log what `insecure_listen_anywhere` permits.
fn warn_of_exposure(config: &ServerConfig) {
    let without_permission = ServerConfig { insecure_listen_anywhere: false, ..config.clone() };
    if let Err(exposure) = without_permission.check() {
        tracing::warn!("insecure_listen_anywhere is set: {exposure}");
    }
}

fn journal_options(config: &ServerConfig) -> JournalOptions {
    JournalOptions {
        folder: config.data_dir.clone(),
        max_frames_per_commit: config.max_frames_per_commit,
        max_waiting_commits: config.max_waiting_commits,
        min_free_disk_bytes: config.min_free_disk_bytes,
    }
}

fn readiness(journal: &JournalHealth) -> Readiness {
    match journal.check() {
        Ok(()) => Readiness::Ready,
        Err(error) => Readiness::NotReady(format!("frames cannot be made durable: {error}")),
    }
}

/// gRPC beside HTTP on one router. Unknown paths are the HTTP side's to answer.
async fn router(
    config: &ServerConfig,
    ingest: IngestGrpc,
    admin: AdminGrpc,
    http: ServeState,
) -> Result<(HealthReporter, Router), StartError> {
    let (reporter, health) = tonic_health::server::health_reporter();
    reporter.set_serving::<IngestServiceServer<IngestGrpc>>().await;
    reporter.set_serving::<MapServiceServer<MapGrpc>>().await;
    reporter.set_serving::<AdminServiceServer<AdminGrpc>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(v1::FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .build_v1()?;
    let maps = MapServiceServer::new(MapGrpc::new(http.sessions.clone(), http.map.clone(), http.feeds.clone()))
        .send_compressed(CompressionEncoding::Gzip);
    let ingest = BoundedIngest::new(ingest, config.max_message_bytes);
    let routes = Routes::from(serve::router(http))
        .add_service(ingest)
        .add_service(AdminServiceServer::new(admin))
        .add_service(maps)
        .add_service(health)
        .add_service(reflection);
    let router = routes.into_axum_router().layer(middleware::from_fn(telemetry::requests::observe));
    Ok((reporter, link_base::mounted(router, &config.base_path)))
}
