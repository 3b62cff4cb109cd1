//! JSON whose every complaint names the file and the field.

use std::{
    fs,
    path::{Path, PathBuf},
};

use nalgebra::{Matrix4, Point3};
use serde_json::Value;

use lanemap_core::geometry::{Pose, pose::pose_from_matrix};

use crate::error::OpenLaneError;

/// Largest file read; a frame of a hundred dense lanes has a few megabytes.
const MAX_FILE_BYTES: u64 = 64 << 20;

/// A parsed file.
pub(crate) struct Document {
    path: PathBuf,
    root: Value,
}

impl Document {
    pub(crate) fn read(path: &Path) -> Result<Self, OpenLaneError> {
        let io = |source| OpenLaneError::Io { path: path.to_owned(), source };
        let bytes = fs::metadata(path).map_err(io)?.len();
        if bytes > MAX_FILE_BYTES {
            return Err(OpenLaneError::TooLarge { path: path.to_owned(), bytes, limit: MAX_FILE_BYTES });
        }
        Self::parse(path, &fs::read(path).map_err(io)?)
    }

    /// The document that `text` holds; `path` is for messages.
    pub(crate) fn parse(path: &Path, text: &[u8]) -> Result<Self, OpenLaneError> {
        let root =
            serde_json::from_slice(text).map_err(|source| OpenLaneError::Json { path: path.to_owned(), source })?;
        Ok(Self { path: path.to_owned(), root })
    }

    pub(crate) fn root(&self) -> Node<'_> {
        Node { path: &self.path, field: String::new(), value: &self.root }
    }
}

/// A value within a file, which knows where it stands.
pub(crate) struct Node<'a> {
    path: &'a Path,
    field: String,
    value: &'a Value,
}

impl<'a> Node<'a> {
    /// The value of a key, or `None` where there is no such key or it is null.
    pub(crate) fn find(&self, key: &str) -> Option<Self> {
        let value = self.value.get(key).filter(|value| !value.is_null())?;
        let field = if self.field.is_empty() { key.to_owned() } else { format!("{}.{key}", self.field) };
        Some(Node { path: self.path, field, value })
    }

    pub(crate) fn get(&self, key: &str) -> Result<Self, OpenLaneError> {
        self.find(key).ok_or_else(|| self.refuse_field(key, "is missing"))
    }

    pub(crate) fn items(&self) -> Result<impl Iterator<Item = Self> + use<'a>, OpenLaneError> {
        let list = self.list()?;
        let (path, field) = (self.path, self.field.clone());
        Ok(list.iter().enumerate().map(move |(index, value)| Node { path, field: format!("{field}[{index}]"), value }))
    }

    pub(crate) fn text(&self) -> Result<&'a str, OpenLaneError> {
        self.value.as_str().ok_or_else(|| self.refuse("is not a text"))
    }

    pub(crate) fn integer(&self) -> Result<i64, OpenLaneError> {
        self.value.as_i64().ok_or_else(|| self.refuse(format!("is {}, not a whole number", brief(self.value))))
    }

    /// Points as rows: `[[x, x, ..], [y, y, ..], [z, z, ..]]`, or an empty list.
    pub(crate) fn points_by_axis(&self) -> Result<Vec<Point3<f64>>, OpenLaneError> {
        let rows = self.list()?;
        if rows.is_empty() {
            return Ok(Vec::new());
        }
        if rows.len() != 3 {
            return Err(self.refuse(format!("has {} rows, want 3 (x, y, z)", rows.len())));
        }
        let axes = self.items()?.map(|row| row.numbers()).collect::<Result<Vec<_>, _>>()?;
        let [x, y, z] = [&axes[0], &axes[1], &axes[2]];
        if x.len() != y.len() || x.len() != z.len() {
            let problem = format!("has rows of {}, {} and {} numbers, want equal lengths", x.len(), y.len(), z.len());
            return Err(self.refuse(problem));
        }
        Ok(x.iter().zip(y).zip(z).map(|((x, y), z)| Point3::new(*x, *y, *z)).collect())
    }

    /// Points as a list of `[x, y, z]`.
    pub(crate) fn points(&self) -> Result<Vec<Point3<f64>>, OpenLaneError> {
        self.items()?
            .map(|item| match item.numbers()?.as_slice() {
                [x, y, z] => Ok(Point3::new(*x, *y, *z)),
                other => Err(item.refuse(format!("has {} numbers, want 3 (x, y, z)", other.len()))),
            })
            .collect()
    }

    /// A square matrix of `N` rows.
    pub(crate) fn matrix<const N: usize>(&self) -> Result<[[f64; N]; N], OpenLaneError> {
        let mut matrix = [[0.0; N]; N];
        let rows = self.list()?.len();
        if rows != N {
            return Err(self.refuse(format!("has {rows} rows, want {N}")));
        }
        for (target, row) in matrix.iter_mut().zip(self.items()?) {
            let numbers = row.numbers()?;
            *target = numbers
                .try_into()
                .map_err(|numbers: Vec<f64>| row.refuse(format!("has {} numbers, want {N}", numbers.len())))?;
        }
        Ok(matrix)
    }

    /// A pose from a 4x4 homogeneous matrix.
    pub(crate) fn pose(&self) -> Result<Pose, OpenLaneError> {
        let rows = self.matrix::<4>()?;
        let matrix = Matrix4::from_fn(|row, column| rows[row][column]);
        pose_from_matrix(&matrix).map_err(|source| self.refuse(source.to_string()))
    }

    pub(crate) fn refuse(&self, problem: impl Into<String>) -> OpenLaneError {
        let field = if self.field.is_empty() { "the file".to_owned() } else { self.field.clone() };
        OpenLaneError::Field { path: self.path.to_owned(), field, problem: problem.into() }
    }

    pub(crate) fn refuse_field(&self, key: &str, problem: &str) -> OpenLaneError {
        let field = if self.field.is_empty() { key.to_owned() } else { format!("{}.{key}", self.field) };
        OpenLaneError::Field { path: self.path.to_owned(), field, problem: problem.to_owned() }
    }

    fn list(&self) -> Result<&'a Vec<Value>, OpenLaneError> {
        self.value.as_array().ok_or_else(|| self.refuse(format!("is {}, not a list", brief(self.value))))
    }

    fn numbers(&self) -> Result<Vec<f64>, OpenLaneError> {
        let number = |(index, value): (usize, &Value)| {
            value.as_f64().ok_or_else(|| {
                let field = format!("{}[{index}]", self.field);
                let problem = format!("is {}, not a number", brief(value));
                OpenLaneError::Field { path: self.path.to_owned(), field, problem }
            })
        };
        self.list()?.iter().enumerate().map(number).collect()
    }
}

/// A value in a few words, whatever its size.
fn brief(value: &Value) -> String {
    match value {
        Value::Null => "null".to_owned(),
        Value::Bool(value) => value.to_string(),
        Value::Number(value) => value.to_string(),
        Value::String(_) => "a text".to_owned(),
        Value::Array(list) => format!("a list of {}", list.len()),
        Value::Object(_) => "an object".to_owned(),
    }
}
