//! Promise: tiles show the shared map as it is, exactly, wherever they are cut; they are made once, known again by their tag,
//! and made anew only where the map changed.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // A test's helpers fail loudly too.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

use lanemap_client::{MapClient, SplineTiles};
use lanemap_core::{EndRule, fleet::CellId, geometry::georeference::Wgs84, spline::Curve};
use lanemap_proto::v1;
use lanemap_server::{RunningServer, fuse::wire::positions};
use lanemap_tests::{
    fleets::{along_a_road, cell_maps, settled},
    http, servers,
};
use lanemap_tiles::{
    TileId,
    lattice::units,
    mercator::{degrees_from_world, world_from_wgs84},
    mvt,
    spline::SplineCurve,
};
use nalgebra::{Point2, Point3};
use prost::Message;
use reqwest::{StatusCode, header};
use serde_json::Value;
use tempfile::TempDir;

/// A server whose map has a road over the border of two cells.
struct Service {
    server: RunningServer,
    cells: Vec<v1::CellMap>,
    _folder: TempDir,
}

impl Service {
    async fn start(seed: u64) -> Self {
        let service = Self::of_road(seed, 2, 250.0, true).await;
        assert_eq!(service.cells.len(), 2, "the road leads over a border");
        service
    }

    async fn of_road(seed: u64, drives: u32, length_m: f64, on_border: bool) -> Self {
        let drives = along_a_road(seed, drives, length_m, on_border);
        let folder = tempfile::tempdir().unwrap();
        let server = servers::start(folder.path()).await;
        for drive in &drives {
            drive.upload_whole(&server.url()).await;
        }
        settled(&server).await;
        let cells: Vec<_> = cell_maps(&server.url()).await.into_iter().filter(|cell| !cell.lanes.is_empty()).collect();
        Self { server, cells, _folder: folder }
    }

    async fn vector_tile(&self, tile: TileId) -> mvt::Tile {
        let answer = http::get(format!("{}/tiles/lanes/{tile}", self.server.url())).await.unwrap();
        mvt::Tile::decode(answer.error_for_status().unwrap().bytes().await.unwrap()).unwrap()
    }

    /// The splines of the map in the units of a zoom, closely sampled, by the ids of their features.
    fn splines(&self, zoom: u8) -> Vec<Vec<Point2<f64>>> {
        let lanes = self.cells.iter().flat_map(|cell| cell.lanes.iter().map(move |lane| (cell, lane)));
        let spline = |(cell, lane): (&v1::CellMap, &v1::FusedLane)| {
            let anchor = cell.cell.parse::<CellId>().unwrap().anchor();
            let points = positions(lane);
            let curve = Curve::new(points.as_slice(), EndRule::Reflected).unwrap();
            let steps = 50 * (points.len() - 1);
            let place = |step| world_from_wgs84(&anchor.wgs84_from_enu(&curve.point(f64::from(step) / 50.0)));
            (0..=u32::try_from(steps).unwrap()).map(|step| place(step) * units(zoom)).collect()
        };
        lanes.map(spline).collect()
    }

    /// The tiles of a zoom in which the map is.
    fn tiles(&self, zoom: u8) -> BTreeSet<TileId> {
        let on = |point: &Point2<f64>| {
            let side = 2_f64.powi(12 + i32::from(zoom));
            let [longitude_deg, latitude_deg] = degrees_from_world(&(point / side));
            TileId::containing(zoom, &Wgs84 { latitude_deg, longitude_deg, height_m: 0.0 }).unwrap()
        };
        self.splines(zoom).iter().flatten().map(on).collect()
    }
}

fn layer<'a>(tile: &'a mvt::Tile, name: &str) -> &'a mvt::Layer {
    tile.layers.iter().find(|layer| layer.name == name).expect("the layer is there")
}

/// The vertices of a tile by layer and line, in units of its zoom.
type Drawn = BTreeMap<(String, u64), BTreeSet<[i64; 2]>>;

fn distance(point: &Point2<f64>, line: &[Point2<f64>]) -> f64 {
    let chords = line.windows(2).filter(|pair| pair[0] != pair[1]).map(|pair| {
        let chord = pair[1] - pair[0];
        let along = ((point - pair[0]).dot(&chord) / chord.norm_squared()).clamp(0.0, 1.0);
        (point - (pair[0] + chord * along)).norm()
    });
    chords.fold(f64::INFINITY, f64::min)
}

#[tokio::test(flavor = "multi_thread")]
async fn every_vertex_of_lines_and_dashes_lies_within_half_a_unit_of_a_spline_and_is_the_same_in_neighbouring_tiles() {
    let service = Service::start(21).await;
    let mut dashes = 0;
    for zoom in [14, 16, 18, 20] {
        let splines = service.splines(zoom);
        let mut shown: BTreeMap<TileId, Drawn> = BTreeMap::new();
        let tiles = service.tiles(zoom);
        for tile in tiles.iter().take(40) {
            let lines = shown.entry(*tile).or_default();
            let corner = tile.corner();
            let layers = service.vector_tile(*tile).await.layers;
            for layer in layers.iter().filter(|layer| ["lanes", "dashes"].contains(&layer.name.as_str())) {
                for feature in &layer.features {
                    let vertices = mvt::line_parts(feature).unwrap().into_iter().flatten();
                    lines
                        .entry((layer.name.clone(), feature.id.unwrap()))
                        .or_default()
                        .extend(vertices.map(|vertex| [0, 1].map(|axis| vertex[axis] + corner[axis])));
                }
            }
        }
        for vertex in shown.values().flat_map(BTreeMap::values).flatten() {
            let vertex = Point2::new(vertex[0] as f64, vertex[1] as f64);
            let nearest = splines.iter().map(|spline| distance(&vertex, spline)).fold(f64::INFINITY, f64::min);
            // A line's end is rounded along the line, too.
            let is_end = splines
                .iter()
                .flat_map(|spline| [spline[0], spline[spline.len() - 1]])
                .any(|end| (end - vertex).amax() <= 0.51);
            assert!(nearest <= 0.52 || is_end, "{nearest} at zoom {zoom}");
        }
        let mut compared = 0;
        for (tile, lines) in &shown {
            let [left, top] = tile.corner();
            // The eastern neighbour shows the last units of this tile, too.
            let Some(neighbour) = TileId::new(zoom, tile.x() + 1, tile.y()).and_then(|next| shown.get(&next)) else {
                continue;
            };
            let both = |vertex: &&[i64; 2]| {
                (left + 4096 - 120..left + 4096 + 120).contains(&vertex[0]) && (top..top + 4096).contains(&vertex[1])
            };
            for (id, vertices) in lines {
                let here: BTreeSet<_> = vertices.iter().filter(both).collect();
                let there: BTreeSet<_> = neighbour.get(id).into_iter().flatten().filter(both).collect();
                assert_eq!(here, there, "line {id:?} of {tile} at zoom {zoom}");
                compared += here.len();
                dashes += if id.0 == "dashes" { here.len() } else { 0 };
            }
        }
        assert!(compared > 0 || tiles.len() < 3, "lines lead over tiles at zoom {zoom}");
    }
    assert!(dashes > 0, "dashes lie at the borders of tiles");
    service.server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tile_is_known_again_by_its_tag_until_its_cells_change() {
    let service = Service::start(22).await;
    let url = |tile: &TileId| format!("{}/tiles/lanes/{tile}", service.server.url());
    let tile = *service.tiles(16).first().unwrap();
    let client = http::client();
    let plain = client.get(url(&tile)).send().await.unwrap();
    assert_eq!(plain.headers()[header::CONTENT_TYPE], "application/vnd.mapbox-vector-tile");
    let tag = plain.headers()[header::ETAG].clone();
    let plain = plain.bytes().await.unwrap();
    let packed = client.get(url(&tile)).header(header::ACCEPT_ENCODING, "gzip").send().await.unwrap();
    assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip");
    assert_ne!(packed.headers()[header::ETAG], tag);
    let mut unpacked = Vec::new();
    let packed = packed.bytes().await.unwrap();
    std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(packed.as_ref()), &mut unpacked).unwrap();
    assert_eq!(unpacked, plain);
    let again = client.get(url(&tile)).header(header::IF_NONE_MATCH, &tag).send().await.unwrap();
    assert_eq!((again.status(), again.headers()[header::ETAG].clone()), (StatusCode::NOT_MODIFIED, tag.clone()));
    for suffix in [".mvt", ".pbf"] {
        assert_eq!(http::get(format!("{}{suffix}", url(&tile))).await.unwrap().bytes().await.unwrap(), plain);
    }

    let [x, y] = [tile.x() ^ 0x4000, tile.y()];
    let empty = http::get(url(&TileId::new(16, x, y).unwrap())).await.unwrap();
    assert_eq!(empty.status(), StatusCode::NO_CONTENT);

    along_a_road(22, 3, 250.0, true)[2].upload_whole(&service.server.url()).await;
    settled(&service.server).await;
    let anew = client.get(url(&tile)).header(header::IF_NONE_MATCH, &tag).send().await.unwrap();
    assert_eq!(anew.status(), StatusCode::OK);
    assert_ne!(anew.headers()[header::ETAG], tag);
    service.server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn spline_tiles_give_the_rust_client_every_line_within_a_centimetre_in_half_a_kilobyte_per_kilometre() {
    let service = Service::of_road(23, 2, 700.0, false).await;
    let tiles = SplineTiles::new(MapClient::new(service.server.url()), 4);
    let (mut bytes, mut line_m) = (0, 0.0);
    for cell in &service.cells {
        let id: CellId = cell.cell.parse().unwrap();
        let tile = TileId::new(14, id.x(), id.y()).unwrap();
        let read = tiles.tile(tile).await.unwrap();
        let unchanged = tiles.tile(tile).await.unwrap();
        assert!(Arc::ptr_eq(&read, &unchanged), "the second answer says that nothing changed");
        let answer = http::get(format!("{}/splines/{tile}", service.server.url())).await.unwrap();
        bytes += answer.bytes().await.unwrap().len();
        let here = read.iter().find(|read| read.cell == id).unwrap();
        assert_eq!((here.version, here.lines.len()), (cell.version, cell.lanes.len()));
        for lane in &cell.lanes {
            let line = here.lines.iter().find(|line| line.id_text() == lane.id && line.part == lane.part).unwrap();
            assert_eq!(line.category, lane.category());
            assert_follows(&line.curve, &positions(lane));
        }
        line_m += read.iter().flat_map(|cell| &cell.lines).map(|line| line.curve.last_parameter()).sum::<f64>();
    }
    let bytes_per_km = bytes as f64 / (line_m / 1e3);
    assert!(bytes_per_km <= 500.0, "{bytes_per_km} bytes per kilometre, of {line_m} m");
    service.server.shutdown().await;
}

/// Every point of the spline through some control points lies within a centimetre of a curve.
fn assert_follows(curve: &SplineCurve, points: &[Point3<f64>]) {
    let spline = Curve::new(points, EndRule::Reflected).unwrap();
    let sampled: Vec<Point3<f64>> = curve.sample(0.1).iter().map(|point| point.position).collect();
    for step in 0..=8 * (points.len() - 1) {
        let point = spline.point(step as f64 / 8.0);
        let nearest = sampled.windows(2).map(|pair| {
            let chord = pair[1] - pair[0];
            let along = ((point - pair[0]).dot(&chord) / chord.norm_squared().max(1e-12)).clamp(0.0, 1.0);
            (point - (pair[0] + chord * along)).norm()
        });
        let nearest_m = nearest.fold(f64::INFINITY, f64::min);
        assert!(nearest_m <= 0.0101, "{nearest_m} m");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn lines_of_a_spline_tile_go_on_in_the_next_cell_at_the_same_place() {
    let service = Service::start(25).await;
    let tiles = SplineTiles::new(MapClient::new(service.server.url()), 4);
    let mut places = BTreeMap::new();
    for cell in &service.cells {
        let id: CellId = cell.cell.parse().unwrap();
        let read = tiles.tile(TileId::new(14, id.x(), id.y()).unwrap()).await.unwrap();
        for line in read.iter().filter(|read| read.cell == id).flat_map(|read| &read.lines) {
            for border in [&line.begins_at, &line.ends_at].into_iter().flatten() {
                places.insert((id, line.id, line.part), border.clone());
            }
        }
    }
    let mut joined = 0;
    for (name, border) in &places {
        let Some(next) = border.continues_in else { continue };
        assert_eq!((places[&next].place, places[&next].continues_in), (border.place, Some(*name)));
        joined += 1;
    }
    assert!(joined >= 6, "only {joined} lines go on");
    service.server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn tiles_are_described_by_tilejson_and_drawn_by_a_style() {
    let service = Service::start(24).await;
    let url = service.server.url();
    let json = |path: &str| {
        let url = format!("{url}{path}");
        async move { http::get(url).await.unwrap().error_for_status().unwrap().json::<Value>().await.unwrap() }
    };
    let described = json("/tiles/lanes").await;
    assert_eq!(
        (&described["tilejson"], &described["minzoom"], &described["maxzoom"]),
        (&"3.0.0".into(), &12.into(), &20.into())
    );
    assert_eq!(described["tiles"][0], format!("{url}/tiles/lanes/{{z}}/{{x}}/{{y}}"));
    let bounds: Vec<f64> = described["bounds"].as_array().unwrap().iter().map(|edge| edge.as_f64().unwrap()).collect();
    let anchor = service.cells[0].anchor.unwrap();
    assert!(bounds[0] < anchor.longitude_deg && anchor.longitude_deg < bounds[2]);

    let tile = service.vector_tile(*service.tiles(16).first().unwrap()).await;
    for layer in described["vector_layers"].as_array().unwrap() {
        let drawn = self::layer(&tile, layer["id"].as_str().unwrap());
        let told: BTreeSet<&str> = layer["fields"].as_object().unwrap().keys().map(String::as_str).collect();
        assert_eq!(drawn.keys.iter().map(String::as_str).collect::<BTreeSet<_>>(), told);
        let ids: BTreeSet<_> = drawn.features.iter().map(|feature| feature.id.unwrap()).collect();
        assert_eq!(ids.len(), drawn.features.len(), "ids are unique");
    }
    let style = json("/styles/lanes.json").await;
    assert_eq!(style["sources"]["lanes"]["url"], format!("{url}/tiles/lanes"));
    assert!(style.get("glyphs").is_none() && style.get("sprite").is_none());
    for path in ["/tiles/lanes/11/0/0", "/tiles/lanes/14/16384/0", "/tiles/lanes/14/a/0", "/splines/9/0/0"] {
        let refused = http::get(format!("{url}{path}")).await.unwrap();
        assert_eq!(refused.status(), StatusCode::NOT_FOUND, "{path}");
        assert_eq!(refused.json::<Value>().await.unwrap()["type"], "urn:lanemap:problem:no-such-tile");
    }
    service.server.shutdown().await;
}
