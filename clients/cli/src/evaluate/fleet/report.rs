//! The figures of fused maps as tables and as JSON.

use lanemap_core::evaluation::{ChangeScore, FleetScore, fleet_score::Quantiles};
use serde_json::{Value, json};

use super::{ByDrives, FleetArgs, Road, absolute_by_drives, loop_closure::LoopClosure};
use crate::evaluate::table::Table;

/// Prints the figures.
pub fn print(args: &FleetArgs, figures: &[(&Road, Vec<ByDrives>)]) -> anyhow::Result<()> {
    if args.json {
        println!("{}", serde_json::to_string_pretty(&as_json(figures))?);
    } else {
        print!("{}", as_text(figures));
    }
    Ok(())
}

impl ByDrives {
    /// Mean of a figure over the choices of drives.
    pub fn mean(&self, figure: impl Fn(&FleetScore) -> f64) -> f64 {
        self.scores.iter().map(figure).sum::<f64>() / self.scores.len().max(1) as f64
    }

    fn quantiles(&self, of: impl Fn(&FleetScore) -> Quantiles) -> Value {
        json!({ "p50": self.mean(|score| of(score).p50), "p95": self.mean(|score| of(score).p95) })
    }
}

fn as_json(figures: &[(&Road, Vec<ByDrives>)]) -> Value {
    let by_drives = |figure: &ByDrives| {
        json!({
            "n": figure.drives,
            "coverage": figure.mean(|score| score.coverage),
            "precision": figure.mean(|score| score.precision),
            "relative_m": figure.quantiles(|score| score.relative),
            "absolute_m": figure.quantiles(|score| score.absolute),
            "relative_height_m": figure.quantiles(|score| score.relative_height),
            "absolute_height_m": figure.quantiles(|score| score.absolute_height),
            "kept_apart": figure.apart,
            "kept_ids": figure.kept_names,
            "bytes_per_km": 1000.0 * figure.bytes / figure.mean(|score| score.length_m).max(1.0),
            "driven_km": figure.driven_m / 1e3,
            "fuse_ms": figure.fuse_ms,
            "changes": figure.changes.map(changes_as_json),
            "loop": figure.closure.map(closure_as_json),
        })
    };
    let roads = figures.iter().map(
        |(road, figures)| json!({ "road": road.name, "by_drives": figures.iter().map(by_drives).collect::<Vec<_>>() }),
    );
    let absolute = absolute_by_drives(figures);
    let absolute = absolute.iter().map(|(drives, error_m)| json!({ "n": drives, "absolute_rms_m": error_m }));
    json!({ "roads": roads.collect::<Vec<_>>(), "all": absolute.collect::<Vec<_>>() })
}

fn changes_as_json(changes: ChangeScore) -> Value {
    json!({
        "precision": changes.precision,
        "recall": changes.recall,
        "latency_drives_p50": changes.latency_drives_p50,
        "false_removals": changes.false_removals,
        "true_pieces": changes.true_pieces,
        "reported_pieces": changes.reported_pieces,
    })
}

fn closure_as_json(closure: LoopClosure) -> Value {
    json!({
        "places": closure.places,
        "lateral_m": { "p50": closure.lateral.p50, "p95": closure.lateral.p95 },
        "height_m": { "p50": closure.height.p50, "p95": closure.height.p95 },
        "by_odometry_m": closure.by_odometry_m,
    })
}

/// The absolute error of all worlds by the number of drives, beside its fall with the square root; nothing of one world.
fn absolute_as_text(figures: &[(&Road, Vec<ByDrives>)]) -> String {
    let all = absolute_by_drives(figures);
    let Some((fewest, first_m)) = all.first().filter(|_| figures.len() > 1 && all.len() > 1) else {
        return String::new();
    };
    let mut table = Table::new(&["drives", "absolute, rms", "1/sqrt(drives)", "ratio"]);
    for (drives, error_m) in &all {
        let falling_m = first_m * (*fewest as f64 / *drives as f64).sqrt();
        table.row(vec![
            drives.to_string(),
            format!("{error_m:.3}"),
            format!("{falling_m:.3}"),
            format!("{:.2}", error_m / falling_m),
        ]);
    }
    format!("\nMedian absolute error over all worlds, metres.\n\n{}", table.render())
}

/// How well drives that came back over their own road lie on themselves; nothing where none did.
fn closures_as_text(figures: &[(&Road, Vec<ByDrives>)]) -> String {
    let mut table = Table::new(&["road", "places", "lateral p50", "p95", "height p50", "p95", "apart by odometry"]);
    let closures = figures.iter().flat_map(|(road, figures)| figures.iter().map(move |figure| (road, figure.closure)));
    let mut any = false;
    for (road, closure) in closures {
        let Some(closure) = closure else { continue };
        any = true;
        table.row(vec![
            road.name.clone(),
            closure.places.to_string(),
            format!("{:.3}", closure.lateral.p50),
            format!("{:.3}", closure.lateral.p95),
            format!("{:.3}", closure.height.p50),
            format!("{:.3}", closure.height.p95),
            format!("{:.1}", closure.by_odometry_m),
        ]);
    }
    let heading = "Places that a drive passed twice: by how much more it is off the second time, metres.";
    if any { format!("\n{heading}\n\n{}", table.render()) } else { String::new() }
}

/// How well changes were noticed, a line for each number of drives; nothing where that is not asked.
fn changes_as_text(figures: &[(&Road, Vec<ByDrives>)]) -> String {
    let mut table =
        Table::new(&["road", "drives", "precision", "recall", "latency p50", "false removals", "pieces", "km"]);
    let asked = figures.iter().flat_map(|(road, figures)| figures.iter().map(move |figure| (road, figure)));
    let (mut any, mut false_removals, mut driven_m) = (false, 0, 0.0);
    for (road, figure) in asked {
        let Some(changes) = figure.changes else { continue };
        any = true;
        false_removals += changes.false_removals;
        driven_m += figure.driven_m;
        table.row(vec![
            road.name.clone(),
            figure.drives.to_string(),
            format!("{:.3}", changes.precision),
            format!("{:.3}", changes.recall),
            format!("{:.0}", changes.latency_drives_p50),
            changes.false_removals.to_string(),
            changes.true_pieces.to_string(),
            format!("{:.0}", figure.driven_m / 1e3),
        ]);
    }
    let heading = "Changes, per piece of 10 m; latency in drives.";
    let sum = format!("{false_removals} false removals in {:.0} km", driven_m / 1e3);
    if any { format!("\n{heading}\n\n{}\n{sum}\n", table.render()) } else { String::new() }
}

fn as_text(figures: &[(&Road, Vec<ByDrives>)]) -> String {
    let mut table = Table::new(&[
        "road",
        "drives",
        "lateral p50",
        "p95",
        "absolute p50",
        "p95",
        "height p50",
        "p95",
        "coverage",
        "precision",
        "apart",
        "same ids",
        "B/km",
        "fuse ms",
    ]);
    for (road, figures) in figures {
        for figure in figures {
            let metres = |of: &dyn Fn(&FleetScore) -> f64| format!("{:.3}", figure.mean(of));
            table.row(vec![
                road.name.clone(),
                figure.drives.to_string(),
                metres(&|score| score.relative.p50),
                metres(&|score| score.relative.p95),
                metres(&|score| score.absolute.p50),
                metres(&|score| score.absolute.p95),
                metres(&|score| score.relative_height.p50),
                metres(&|score| score.relative_height.p95),
                metres(&|score| score.coverage),
                metres(&|score| score.precision),
                format!("{:.1}", figure.apart),
                figure.kept_names.map_or_else(|| "-".to_owned(), |kept| format!("{kept:.2}")),
                format!("{:.0}", 1000.0 * figure.bytes / figure.mean(|score| score.length_m).max(1.0)),
                format!("{:.0}", figure.fuse_ms),
            ]);
        }
    }
    format!(
        "Errors in metres; lateral and height after one rigid motion of the whole map.\n\n{}{}{}{}",
        table.render(),
        absolute_as_text(figures),
        closures_as_text(figures),
        changes_as_text(figures)
    )
}
