//! Filters by properties: equality, by the property's name (OGC 17-069r4, 7.15.5), and bounds on figures.

use lanemap_core::{Category, fleet::CellId};

use super::collection::Collection;
use crate::serve::{features::category_name, problem::Problem, query::Parameters};

/// What the features of an answer must have.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in crate::serve) struct Filters {
    pub(in crate::serve) category: Option<Category>,
    pub(in crate::serve) cell: Option<CellId>,
    pub(in crate::serve) lane: Option<String>,
    pub(in crate::serve) session: Option<String>,
    drives: Option<u32>,
    min_drives: Option<u32>,
    min_existence: Option<f64>,
    max_lateral_sigma_m: Option<f64>,
}

/// What filters look at in a feature, as its properties have it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::serve) struct Filtered {
    pub(in crate::serve) category: Category,
    pub(in crate::serve) drives: u32,
    pub(in crate::serve) existence: f64,
    pub(in crate::serve) lateral_sigma_m: f64,
}

impl Filters {
    /// Reads those of a collection; others are unknown to the parameters as a whole.
    pub(super) fn read(parameters: &Parameters, collection: &Collection) -> Result<Self, Problem> {
        let has = |name: &str| collection.filters.iter().any(|filter| filter.name == name);
        let text = |text: &str| Ok(text.to_owned());
        let mut filters = Self {
            category: parameters.get("category", category)?,
            lane: parameters.get("lane", text)?,
            session: parameters.get("session", text)?,
            drives: parameters.get("drives", count)?,
            min_drives: parameters.get("min_drives", count)?,
            min_existence: parameters.get("min_existence", |text| figure(text, 1.0))?,
            max_lateral_sigma_m: parameters.get("max_lateral_sigma_m", |text| figure(text, f64::MAX))?,
            cell: None,
        };
        if has("cell") {
            filters.cell = parameters.get("cell", |text| text.parse::<CellId>().map_err(|error| error.to_string()))?;
        }
        Ok(filters)
    }

    /// Whether every feature passes.
    pub(in crate::serve) fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Whether a feature passes, names aside.
    pub(in crate::serve) fn pass(&self, feature: &Filtered) -> bool {
        self.category.is_none_or(|category| feature.category == category)
            && self.drives.is_none_or(|drives| feature.drives == drives)
            && self.min_drives.is_none_or(|least| feature.drives >= least)
            && self.min_existence.is_none_or(|least| feature.existence >= least)
            && self.max_lateral_sigma_m.is_none_or(|most| feature.lateral_sigma_m <= most)
    }
}

fn category(text: &str) -> Result<Category, String> {
    let named = Category::ALL.into_iter().find(|category| category_name(*category) == text);
    named.ok_or_else(|| {
        let names: Vec<&str> = Category::ALL.into_iter().map(category_name).collect();
        format!("it must be one of {}", names.join(", "))
    })
}

fn count(text: &str) -> Result<u32, String> {
    let count = text.parse::<i32>().ok().and_then(|count| u32::try_from(count).ok());
    count.ok_or_else(|| format!("it must be a whole number in 0 ..= {}", i32::MAX))
}

fn figure(text: &str, most: f64) -> Result<f64, String> {
    let figure = text.parse::<f64>().ok().filter(|figure| (0.0..=most).contains(figure));
    figure.ok_or_else(|| {
        if most < f64::MAX {
            format!("it must be a number in 0 ..= {most}")
        } else {
            "it must be a number, not negative".into()
        }
    })
}
