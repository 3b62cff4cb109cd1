//! The figures of map quality as tables and as JSON.

use std::collections::BTreeMap;

use lanemap_core::evaluation::{Counts, quantile};
use serde_json::{Value, json};

use super::{
    map_quality::{DriveScore, MapArgs, MapScore},
    preset_name,
    table::Table,
};

/// Drives that are told apart by their names, as the shared drives are named; the paper's scenarios need its own folders.
fn scenario(drive: &str) -> &'static str {
    let name = drive.trim_start_matches("segment-");
    let traversal = name.rsplit_once("-t").is_some_and(|(_, number)| number.parse::<u32>().is_ok());
    if traversal {
        "repeated roads"
    } else if name.starts_with("av2") {
        "city, many lanes (Argoverse)"
    } else if name.starts_with("ps") {
        "road, 3 or 4 lines (PandaSet)"
    } else {
        "other"
    }
}

/// The scores of some drives, summed: detections first, then each preset.
struct Summed {
    frames: usize,
    methods: Vec<(&'static str, MapScore)>,
}

fn sum<'a>(drives: impl Iterator<Item = &'a DriveScore>) -> Summed {
    let mut summed = Summed { frames: 0, methods: Vec::new() };
    for drive in drives {
        summed.frames += drive.frames;
        let maps = drive.maps.iter().map(|(preset, score)| (preset_name(*preset), score));
        for (index, (name, score)) in [("detections", &drive.raw)].into_iter().chain(maps).enumerate() {
            match summed.methods.get_mut(index) {
                Some((_, total)) => *total += score,
                None => summed.methods.push((name, score.clone())),
            }
        }
    }
    summed
}

pub fn print(args: &MapArgs, drives: &[DriveScore]) -> anyhow::Result<()> {
    let mut scenarios: BTreeMap<&str, Vec<&DriveScore>> = BTreeMap::new();
    for drive in drives {
        scenarios.entry(scenario(&drive.name)).or_default().push(drive);
    }
    let rows: Vec<(String, Summed)> = drives
        .iter()
        .map(|drive| (drive.name.trim_start_matches("segment-").to_owned(), sum(std::iter::once(drive))))
        .collect();
    let groups: Vec<(String, Summed)> =
        scenarios.iter().map(|(name, drives)| ((*name).to_owned(), sum(drives.iter().copied()))).collect();
    let overall = sum(drives.iter());
    if args.common.json {
        println!("{}", serde_json::to_string_pretty(&as_json(args, &rows, &groups, &overall))?);
    } else {
        print!("{}", as_text(args, &rows, &groups, &overall));
    }
    Ok(())
}

fn as_text(args: &MapArgs, drives: &[(String, Summed)], groups: &[(String, Summed)], overall: &Summed) -> String {
    let noise = args.disturbance.pose_noise;
    let mut text = format!(
        "Map quality, {} frames; pose noise {} deg, {} m; drop {}; seed {}. F1 by the paper's scorer / by the strict one.\n\n",
        overall.frames, noise.yaw_deg, noise.shift_m, args.disturbance.drop, args.common.seed
    );
    let mut header = vec!["", "frames"];
    header.extend(overall.methods.iter().map(|(name, _)| *name));
    let mut table = Table::new(&header);
    let both = |score: &MapScore| format!("{:.3} / {:.3}", score.authors.f1(), score.strict.f1());
    let all = ("all".to_owned(), overall);
    let rows = drives.iter().chain(groups).map(|(name, summed)| (name, summed)).chain([(&all.0, all.1)]);
    for (name, summed) in rows {
        let mut cells = vec![name.clone(), summed.frames.to_string()];
        cells.extend(summed.methods.iter().map(|(_, score)| both(score)));
        table.row(cells);
    }
    text.push_str(&table.render());
    text.push('\n');

    let mut table = Table::new(&[
        "all drives",
        "F1",
        "recall",
        "precision",
        "strict F1",
        "recall",
        "precision",
        "lateral p50",
        "p95 (m)",
        "vertical p50",
        "p95 (m)",
    ]);
    for (name, score) in &overall.methods {
        let ratios = |counts: &Counts| [counts.f1(), counts.recall(), counts.precision()];
        let numbers = ratios(&score.authors).into_iter().chain(ratios(&score.strict)).chain(error_quantiles(score));
        let mut cells = vec![(*name).to_owned()];
        cells.extend(numbers.map(|number| format!("{number:.3}")));
        table.row(cells);
    }
    text.push_str(&table.render());
    text
}

/// Lateral p50 and p95, vertical p50 and p95, metres.
fn error_quantiles(score: &MapScore) -> [f64; 4] {
    let mut lateral: Vec<f64> = score.errors.iter().map(|error| error.lateral_m).collect();
    let mut vertical: Vec<f64> = score.errors.iter().map(|error| error.vertical_m).collect();
    [
        quantile(&mut lateral, 0.5),
        quantile(&mut lateral, 0.95),
        quantile(&mut vertical, 0.5),
        quantile(&mut vertical, 0.95),
    ]
}

fn as_json(args: &MapArgs, drives: &[(String, Summed)], groups: &[(String, Summed)], overall: &Summed) -> Value {
    let noise = args.disturbance.pose_noise;
    let named = |rows: &[(String, Summed)]| -> Value {
        rows.iter().map(|(name, summed)| (name.clone(), summed_json(summed))).collect::<serde_json::Map<_, _>>().into()
    };
    json!({
        "measure": "map",
        "seed": args.common.seed,
        "pose_noise": { "yaw_deg": noise.yaw_deg, "shift_m": noise.shift_m },
        "drop": args.disturbance.drop,
        "overall": summed_json(overall),
        "scenarios": named(groups),
        "drives": named(drives),
    })
}

fn summed_json(summed: &Summed) -> Value {
    let mut object = serde_json::Map::new();
    object.insert("frames".to_owned(), summed.frames.into());
    for (name, score) in &summed.methods {
        let [lateral_50, lateral_95, vertical_50, vertical_95] = error_quantiles(score);
        let value = json!({
            "authors": counts_json(&score.authors),
            "strict": counts_json(&score.strict),
            "lateral_m": { "p50": lateral_50, "p95": lateral_95 },
            "vertical_m": { "p50": vertical_50, "p95": vertical_95 },
        });
        object.insert((*name).to_owned(), value);
    }
    object.into()
}

fn counts_json(counts: &Counts) -> Value {
    json!({
        "f1": counts.f1(),
        "recall": counts.recall(),
        "precision": counts.precision(),
        "tp": counts.true_positives,
        "truth": counts.truths,
        "pred": counts.predictions,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drives_are_grouped_by_what_their_names_say() {
        assert_eq!(scenario("segment-av2-3bffdcff-t0"), "repeated roads");
        assert_eq!(scenario("segment-av2-3bffdcff-real"), "city, many lanes (Argoverse)");
        assert_eq!(scenario("segment-ps-001-real"), "road, 3 or 4 lines (PandaSet)");
        assert_eq!(scenario("segment-10203656353524179475_7625"), "other");
    }
}
