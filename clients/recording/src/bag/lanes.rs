//! What messages of a bag mean: where the camera is, and which lines it sees.

use lanemap_core::{Category, Detection, TimestampNs, geometry::Pose};
use nalgebra::{Point3, Quaternion, Translation3, UnitQuaternion};

use super::{
    definition::{Definitions, Field, Kind, Primitive, ROOT, shown},
    view::{self, View},
};

/// How far the norm of a quaternion may be from 1.
const ROTATION_NORM_TOLERANCE: f64 = lanemap_proto::decode::ROTATION_NORM_TOLERANCE;
/// Most messages between a pose message and its position: `pose.pose.position` of an odometry has two.
const MAX_POSE_DEPTH: usize = 4;

/// How to read messages of one connection.
#[derive(Debug)]
pub(crate) struct PoseReader {
    definitions: Definitions,
    stamp: [String; 2],
    /// Fields from the message to the one that has position and orientation.
    path: Vec<String>,
}

/// How to read the lanes of one connection.
#[derive(Debug)]
pub(crate) struct LanesReader {
    definitions: Definitions,
    stamp: [String; 2],
    lanes: String,
    points: String,
    has_category: bool,
}

impl PoseReader {
    /// A reader for messages of this definition; says what they lack.
    pub(crate) fn new(definitions: Definitions) -> Result<Self, String> {
        let stamp = stamp_of(&definitions)?;
        let mut path = Vec::new();
        let mut at = ROOT.clone();
        loop {
            if let (Some(position), Some(orientation)) =
                (field(&definitions, &at, "position"), field(&definitions, &at, "orientation"))
            {
                numbers(&definitions, &position.kind, &["x", "y", "z"])?;
                numbers(&definitions, &orientation.kind, &["x", "y", "z", "w"])?;
                break;
            }
            let Some(pose) = field(&definitions, &at, "pose").filter(|_| path.len() < MAX_POSE_DEPTH) else {
                let place = if path.is_empty() { "it".to_owned() } else { path.join(".") };
                return Err(format!("{place} has neither position and orientation nor a pose"));
            };
            path.push("pose".to_owned());
            at = pose.kind.clone();
        }
        Ok(Self { definitions, stamp, path })
    }

    /// Stamp and pose of a message: the camera in the world, as the authors' `/gt_pose_wc` has it.
    pub(crate) fn read(&self, bytes: &[u8]) -> Result<(TimestampNs, Pose), String> {
        let message = view::message(&self.definitions, bytes)?;
        let time = stamp(&message, &self.stamp)?;
        let mut pose = message;
        for name in &self.path {
            pose = pose.field(name).ok_or_else(|| format!("has no {name}"))?;
        }
        let [x, y, z] = vector(&pose, "position", ["x", "y", "z"])?;
        let [i, j, k, w] = vector(&pose, "orientation", ["x", "y", "z", "w"])?;
        let rotation = Quaternion::new(w, i, j, k);
        let norm = rotation.norm();
        if (norm - 1.0).abs() > ROTATION_NORM_TOLERANCE {
            return Err(format!("orientation has the norm {norm}, limit 1 +- {ROTATION_NORM_TOLERANCE}"));
        }
        Ok((time, Pose::from_parts(Translation3::new(x, y, z), UnitQuaternion::new_normalize(rotation))))
    }
}

impl LanesReader {
    /// A reader for messages of this definition; says what they lack.
    pub(crate) fn new(definitions: Definitions) -> Result<Self, String> {
        let stamp = stamp_of(&definitions)?;
        let mut found = Vec::new();
        for lanes in fields(&definitions, &ROOT) {
            let Kind::List(lane, _) = &lanes.kind else { continue };
            for points in fields(&definitions, lane) {
                let Kind::List(point, _) = &points.kind else { continue };
                if numbers(&definitions, point, &["x", "y", "z"]).is_ok() {
                    found.push((lanes.name.clone(), points.name.clone(), (**lane).clone()));
                }
            }
        }
        let (lanes, points, lane) = match found.as_slice() {
            [one] => one.clone(),
            [] => return Err("it has no list of lanes with a list of points of x, y, z".to_owned()),
            several => {
                let named: Vec<_> = several.iter().map(|(lanes, points, _)| format!("{lanes}[].{points}[]")).collect();
                return Err(format!("it has several lists of points: {}", named.join(", ")));
            }
        };
        let has_category = match field(&definitions, &lane, "category") {
            None => false,
            Some(Field { kind: Kind::Primitive(kind), .. }) if is_whole(*kind) => true,
            Some(Field { kind, .. }) => {
                return Err(format!("{lanes}[].category is {}, want a whole number", definitions.name(kind)));
            }
        };
        Ok(Self { definitions, stamp, lanes, points, has_category })
    }

    /// Whether lanes say what they are painted as.
    pub(crate) fn has_category(&self) -> bool {
        self.has_category
    }

    /// Path of the points in a message.
    pub(crate) fn points_path(&self) -> String {
        format!("{}[].{}[]", self.lanes, self.points)
    }

    /// Stamp of a message.
    pub(crate) fn stamp(&self, bytes: &[u8]) -> Result<TimestampNs, String> {
        stamp(&view::message(&self.definitions, bytes)?, &self.stamp)
    }

    /// The lines of a message, their points brought to the vehicle frame. A lane of less than two points is no line.
    pub(crate) fn read(&self, bytes: &[u8], vehicle_from_camera: &Pose) -> Result<Vec<Detection>, String> {
        let message = view::message(&self.definitions, bytes)?;
        let lanes = message.field(&self.lanes).ok_or_else(|| format!("has no {}", self.lanes))?;
        let mut detections = Vec::new();
        for (index, lane) in lanes.elements().enumerate() {
            let place = || format!("{}[{index}]", self.lanes);
            let points = lane.field(&self.points).ok_or_else(|| format!("{} has no {}", place(), self.points))?;
            let points = points.elements().enumerate().map(|(k, point)| {
                let [x, y, z] = coordinates(&point, ["x", "y", "z"]).map_err(|(axis, value)| {
                    format!("{}.{}[{k}].{axis} is {value}, want a finite number", place(), self.points)
                })?;
                Ok(vehicle_from_camera * Point3::new(x, y, z))
            });
            let points_vehicle = points.collect::<Result<Vec<_>, String>>()?;
            if points_vehicle.len() >= 2 {
                let category = if self.has_category { category(&lane, &place)? } else { Category::Unknown };
                detections.push(Detection { category, points_vehicle });
            }
        }
        Ok(detections)
    }
}

fn category(lane: &View<'_>, place: &impl Fn() -> String) -> Result<Category, String> {
    let code = lane.field("category").and_then(|category| category.integer());
    let known = code.and_then(|code| u8::try_from(code).ok()).and_then(Category::from_openlane_code);
    known.ok_or_else(|| {
        let code = code.map_or_else(|| "no whole number".to_owned(), |code| code.to_string());
        format!("{}.category is {code}, want an OpenLane code: 0 to 12, 20 or 21", place())
    })
}

/// Where the stamp of a message lies.
fn stamp_of(definitions: &Definitions) -> Result<[String; 2], String> {
    let header = fields(definitions, &ROOT).iter().find_map(|header| {
        let stamp = field(definitions, &header.kind, "stamp")?;
        (stamp.kind == Kind::Primitive(Primitive::Time)).then(|| [header.name.clone(), stamp.name.clone()])
    });
    header.ok_or_else(|| "it has no header with a stamp of type time".to_owned())
}

fn stamp(message: &View<'_>, [header, stamp]: &[String; 2]) -> Result<TimestampNs, String> {
    let stamp = message.field(header).and_then(|header| header.field(stamp)).and_then(|stamp| stamp.time_ns());
    stamp.map(TimestampNs).ok_or_else(|| format!("has no {header}.stamp"))
}

fn fields<'a>(definitions: &'a Definitions, kind: &Kind) -> &'a [Field] {
    match kind {
        Kind::Message(place) => &definitions.message(*place).fields,
        _ => &[],
    }
}

fn field<'a>(definitions: &'a Definitions, kind: &Kind, name: &str) -> Option<&'a Field> {
    fields(definitions, kind).iter().find(|field| field.name == name)
}

/// Whether a message has these fields, and all of them are numbers.
fn numbers(definitions: &Definitions, kind: &Kind, names: &[&str]) -> Result<(), String> {
    for name in names {
        let within = shown(&definitions.name(kind));
        match field(definitions, kind, name) {
            Some(Field { kind: Kind::Primitive(Primitive::Time | Primitive::Duration), .. }) => {
                return Err(format!("{within}.{name} is a time, want a number"));
            }
            Some(Field { kind: Kind::Primitive(_), .. }) => {}
            Some(other) => return Err(format!("{within}.{name} is {}, want a number", definitions.name(&other.kind))),
            None => return Err(format!("{within} has no field {name}")),
        }
    }
    Ok(())
}

fn is_whole(primitive: Primitive) -> bool {
    !matches!(primitive, Primitive::Float32 | Primitive::Float64 | Primitive::Time | Primitive::Duration)
}

fn vector<const N: usize>(message: &View<'_>, name: &str, axes: [&'static str; N]) -> Result<[f64; N], String> {
    let vector = message.field(name).ok_or_else(|| format!("has no {name}"))?;
    coordinates(&vector, axes).map_err(|(axis, value)| format!("{name}.{axis} is {value}, want a finite number"))
}

/// Finite numbers of a message; else the name and the value of the first that is not.
fn coordinates<const N: usize>(message: &View<'_>, axes: [&'static str; N]) -> Result<[f64; N], (&'static str, f64)> {
    let mut values = [0.0; N];
    for (value, axis) in values.iter_mut().zip(axes) {
        *value = message.field(axis).and_then(|field| field.number()).unwrap_or(f64::NAN);
        if !value.is_finite() {
            return Err((axis, *value));
        }
    }
    Ok(values)
}
