//! `lanemap export`: the shared map, or a part of it, as a file for other programs.
//!
//! Cells come one after the other, from a server or from a store that no server has open, and are written as they come.
//! The file is there whole or not at all.

use std::{
    fs,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use lanemap_client::MapClient;
use lanemap_core::fleet::CellId;
use lanemap_proto::v1;
use lanemap_server::{
    export::{self, ExportError, Format, LaneOptions, StoredMap, Summary, TrafficSide},
    serve::bounds::Bounds,
};
use tokio::runtime::Runtime;

use crate::credentials::CredentialArgs;

/// What to export, and where to.
#[derive(Args, Debug)]
#[expect(clippy::doc_markdown, reason = "the comments are the text of --help")]
pub struct ExportArgs {
    /// The format
    #[arg(long, value_enum)]
    format: FormatName,
    /// File to write; what is there is replaced
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
    /// The service to read from [default: http://127.0.0.1:8080]
    #[arg(long, value_name = "URL", conflicts_with = "store")]
    server: Option<String>,
    /// Folder of a store to read from, which no server has open
    #[arg(long, value_name = "DIR")]
    store: Option<PathBuf>,
    /// Only lines that enter this box, degrees: west,south,east,north
    #[arg(long, value_name = "BOX", value_parser = Bounds::parse, allow_hyphen_values = true, conflicts_with = "cell")]
    bbox: Option<Bounds>,
    /// Only this cell: 14-x-y
    #[arg(long, value_name = "CELL")]
    cell: Option<CellId>,
    /// The side of the road on which vehicles drive, for formats with lanes
    #[arg(long, value_enum, default_value_t = Side::Right)]
    traffic: Side,
    #[command(flatten)]
    credentials: CredentialArgs,
}

/// Formats as the command line names them.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum FormatName {
    /// GeoJSON: lines with what is known of them
    Geojson,
    /// FlatGeobuf: the same with a spatial index
    Flatgeobuf,
    /// PMTiles: vector tiles of zooms 12 to 16
    Pmtiles,
    /// Lanelet2, OSM XML: lanes with their neighbours and successors
    Lanelet2,
    /// OpenDRIVE 1.7: roads whose reference lines are the splines
    Opendrive,
}

/// Sides as the command line names them.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Side {
    /// As in most of the world
    Right,
    /// As in Japan or the United Kingdom
    Left,
}

impl From<FormatName> for Format {
    fn from(name: FormatName) -> Self {
        match name {
            FormatName::Geojson => Self::GeoJson,
            FormatName::Flatgeobuf => Self::FlatGeobuf,
            FormatName::Pmtiles => Self::PmTiles,
            FormatName::Lanelet2 => Self::Lanelet2,
            FormatName::Opendrive => Self::OpenDrive,
        }
    }
}

/// Where cells are read from.
enum Source {
    Store(StoredMap),
    Server(Box<(MapClient, Runtime)>),
}

impl Source {
    fn open(args: &ExportArgs) -> anyhow::Result<Self> {
        if let Some(folder) = &args.store {
            let store = StoredMap::open(folder);
            let opened = store.with_context(|| {
                format!("the store in {} cannot be read; where a server has it open, use --server", folder.display())
            });
            return opened.map(Self::Store);
        }
        let runtime = Runtime::new()?;
        let url = args.server.as_deref().unwrap_or("http://127.0.0.1:8080");
        let client = runtime.block_on(MapClient::with(url, &args.credentials.read()))?;
        Ok(Self::Server(Box::new((client, runtime))))
    }

    fn list(&self) -> anyhow::Result<Vec<CellId>> {
        match self {
            Self::Store(store) => Ok(store.list()?),
            Self::Server(server) => {
                let (client, runtime) = server.as_ref();
                let names = runtime.block_on(client.cells())?;
                names.iter().map(|name| name.parse().context("the server lists a cell that is none")).collect()
            }
        }
    }

    fn get(&self, cell: CellId) -> Result<Option<v1::CellMap>, ExportError> {
        match self {
            Self::Store(store) => Ok(store.get(cell)?),
            Self::Server(server) => {
                let (client, runtime) = server.as_ref();
                let map = runtime.block_on(client.cell(&cell.to_string()));
                map.map(Some).map_err(|error| ExportError::Cell(error.to_string()))
            }
        }
    }
}

/// Writes the file.
pub fn run(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let source = Source::open(args)?;
    let known = source.list().context("the list of cells cannot be read")?;
    let cells = wanted(args, known)?;
    let format = Format::from(args.format);
    let traffic = match args.traffic {
        Side::Right => TrafficSide::Right,
        Side::Left => TrafficSide::Left,
    };
    let selected = |map: v1::CellMap| match &args.bbox {
        Some(bounds) => export::within(map, bounds),
        None => Ok(map),
    };
    let maps = cells.iter().filter_map(|cell| source.get(*cell).transpose()).map(|map| map.and_then(selected));
    let summary = written(&args.output, |out| export::write(format, maps, LaneOptions { traffic }, out))?;
    let bytes = fs::metadata(&args.output)?.len();
    println!("{}: {bytes} bytes, {}", args.output.display(), described(&summary, cells.len()));
    if summary.lines == 0 {
        eprintln!("nothing is in it: there are no lines there");
    }
    Ok(ExitCode::SUCCESS)
}

/// The cells to read.
fn wanted(args: &ExportArgs, mut known: Vec<CellId>) -> anyhow::Result<Vec<CellId>> {
    if let Some(cell) = args.cell {
        if !known.contains(&cell) {
            bail!("nothing is known of cell {cell}");
        }
        return Ok(vec![cell]);
    }
    if let Some(bounds) = &args.bbox {
        known.retain(|cell| export::may_enter(*cell, bounds));
    }
    known.sort_unstable();
    Ok(known)
}

/// Writes a file beside the one that it replaces, and puts it in its place once it is whole.
fn written(path: &Path, write: impl FnOnce(&mut dyn Write) -> Result<Summary, ExportError>) -> anyhow::Result<Summary> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let cannot = || format!("{} cannot be written", path.display());
    let file = tempfile::NamedTempFile::new_in(folder).with_context(cannot)?;
    let mut out = BufWriter::new(file);
    let summary = write(&mut out)?;
    let file = out.into_inner().map_err(std::io::IntoInnerError::into_error).with_context(cannot)?;
    make_readable(file.as_file()).with_context(cannot)?;
    file.persist(path).with_context(cannot)?;
    Ok(summary)
}

/// A temporary file is for its owner alone; this one is not.
fn make_readable(file: &fs::File) -> std::io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.set_permissions(fs::Permissions::from_mode(0o644))?;
    }
    Ok(())
}

fn described(summary: &Summary, cells: usize) -> String {
    let counts = [(summary.lanes, "lanes"), (summary.tiles, "tiles")].into_iter().filter(|(count, _)| *count > 0);
    let lines = format!("{} lines of {cells} cells", summary.lines);
    let parts: Vec<String> =
        std::iter::once(lines).chain(counts.map(|(count, name)| format!("{count} {name}"))).collect();
    parts.join(", ")
}
