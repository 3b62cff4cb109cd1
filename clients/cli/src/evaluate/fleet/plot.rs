//! Plots as SVG: each map beside its truth, and the errors by the number of drives; of several worlds also the absolute error
//! of them all, beside the fall with the square root of the number.

use std::{fmt::Write as _, fs, path::Path};

use anyhow::Context;
use lanemap_core::{
    evaluation::FleetScore,
    fleet::{FleetParams, fuse},
};
use nalgebra::Point3;

use super::{ByDrives, Road, absolute_by_drives, polylines};

/// Width of a plot, pixels.
const WIDTH: f64 = 1600.0;

/// Writes `map-N.svg` of each road and `errors.svg`.
pub fn write(folder: &Path, figures: &[(&Road, Vec<ByDrives>)]) -> anyhow::Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("{}", folder.display()))?;
    let save = |name: String, text: String| {
        let path = folder.join(name);
        fs::write(&path, text).with_context(|| format!("{}", path.display()))
    };
    for (number, (road, _)) in figures.iter().enumerate() {
        save(format!("map-{}.svg", number + 1), map(road))?;
    }
    save("errors.svg".to_owned(), errors(figures))
}

/// True lines broad and grey, fused ones thin and blue, of all drives.
fn map(road: &Road) -> String {
    let fused = polylines(&fuse(&road.contributions, &road.anchor, &FleetParams::default()));
    let all = || road.truth.iter().chain(&fused).flatten();
    let low = all().fold(Point3::from([f64::INFINITY; 3]), |low, place| low.inf(place));
    let high = all().fold(Point3::from([f64::NEG_INFINITY; 3]), |high, place| high.sup(place));
    let size = high - low;
    let scale = WIDTH / size.x.max(1.0);
    let height = scale * size.y.max(1.0);
    let mut text = format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height:.0}"><title>{}</title><rect width="100%" height="100%" fill="white"/>"#,
        road.name
    );
    for (lines, style) in
        [(&road.truth, r##"stroke="#bbb" stroke-width="3""##), (&fused, r##"stroke="#04c" stroke-width="1""##)]
    {
        for line in lines {
            let _ = write!(text, r#"<polyline fill="none" {style} points=""#);
            for place in line {
                let _ = write!(text, "{:.1},{:.1} ", scale * (place.x - low.x), height - scale * (place.y - low.y));
            }
            text.push_str(r#""/>"#);
        }
    }
    text + "</svg>\n"
}

/// What is drawn: relative median and 95 % quantile, absolute median, metres.
fn measures(figure: &ByDrives) -> [f64; 3] {
    let mean = |of: fn(&FleetScore) -> f64| figure.mean(of);
    [mean(|score| score.relative.p50), mean(|score| score.relative.p95), mean(|score| score.absolute.p50)]
}

/// Errors by the number of drives, both axes logarithmic: a fall with the square root is a straight line down.
fn errors(figures: &[(&Road, Vec<ByDrives>)]) -> String {
    const HEIGHT: f64 = 900.0;
    let across = |drives: f64| 80.0 + 1400.0 * drives.max(1.0).ln() / 200.0_f64.ln();
    let up = |error_m: f64| HEIGHT - 60.0 - 800.0 * (error_m.max(0.01) / 0.01).ln() / 500.0_f64.ln();
    let mut text = format!(
        r#"<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" font-family="sans-serif" font-size="16"><rect width="100%" height="100%" fill="white"/>"#
    );
    for error_m in [0.01, 0.03, 0.1, 0.3, 1.0, 3.0] {
        let y = up(error_m);
        let _ = write!(text, r##"<path d="M80 {y}H1500" stroke="#ddd"/><text x="10" y="{y}">{error_m} m</text>"##);
    }
    for drives in [1.0, 2.0, 3.0, 6.0, 10.0, 20.0, 30.0, 50.0, 100.0, 200.0] {
        let _ = write!(text, r#"<text x="{:.0}" y="{}">{drives}</text>"#, across(drives), HEIGHT - 30.0);
    }
    for (_, figures) in figures {
        for (measure, colour) in ["#04c", "#c40", "#080"].into_iter().enumerate() {
            let _ = write!(text, r#"<polyline fill="none" stroke="{colour}" stroke-width="1.5" points=""#);
            for figure in figures {
                let _ = write!(text, "{:.1},{:.1} ", across(figure.drives as f64), up(measures(figure)[measure]));
            }
            text.push_str(r#""/>"#);
        }
    }
    let all = absolute_by_drives(figures);
    if let Some((fewest, error_m)) = all.first().filter(|_| figures.len() > 1 && all.len() > 1) {
        let falling = |share: f64| move |drives: usize| share * error_m * (*fewest as f64 / drives as f64).sqrt();
        for (share, style) in [(1.0, "6 4"), (1.25, "2 6"), (0.75, "2 6")] {
            let line = all.iter().map(|(drives, _)| (*drives, falling(share)(*drives)));
            let _ = write!(text, r##"<polyline fill="none" stroke="#888" stroke-dasharray="{style}" points=""##);
            for (drives, error_m) in line {
                let _ = write!(text, "{:.1},{:.1} ", across(drives as f64), up(error_m));
            }
            text.push_str(r#""/>"#);
        }
        let _ = write!(text, r##"<polyline fill="none" stroke="#080" stroke-width="5" points=""##);
        for (drives, error_m) in &all {
            let _ = write!(text, "{:.1},{:.1} ", across(*drives as f64), up(*error_m));
        }
        text.push_str(r#""/>"#);
        text.push_str(
            r##"<text x="1000" y="54" fill="#080">broad: over all worlds; broken: 1/sqrt(drives), within 25 %</text>"##,
        );
    }
    text + r##"<text x="1000" y="30" fill="#04c">relative p50</text><text x="1130" y="30" fill="#c40">relative p95</text><text x="1260" y="30" fill="#080">absolute p50</text></svg>"##
        + "\n"
}
