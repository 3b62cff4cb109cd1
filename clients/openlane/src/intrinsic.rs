//! The pinhole camera of a frame.

use lanemap_core::FieldOfView;

use crate::{error::OpenLaneError, json::Node};

/// Focal lengths and principal point, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsic {
    /// Focal length along the image's rows.
    pub fx: f64,
    /// Focal length along the image's columns.
    pub fy: f64,
    /// Column of the principal point.
    pub cx: f64,
    /// Row of the principal point.
    pub cy: f64,
}

impl Intrinsic {
    pub(crate) fn parse(node: &Node<'_>) -> Result<Self, OpenLaneError> {
        let [[fx, _, cx], [_, fy, cy], _] = node.matrix::<3>()?;
        if fx <= 0.0 || fy <= 0.0 || cx <= 0.0 || cy <= 0.0 {
            return Err(node.refuse(format!("has fx {fx}, fy {fy}, cx {cx}, cy {cy}; all must be above zero")));
        }
        Ok(Self { fx, fy, cx, cy })
    }

    /// What the camera sees. OpenLane's files name no image size: it is taken as `2 cx` by `2 cy`.
    #[must_use]
    pub fn field_of_view(&self) -> FieldOfView {
        let (side, height) = (self.cx / self.fx, self.cy / self.fy);
        FieldOfView { tan_left: side, tan_right: side, tan_up: height, tan_down: height }
    }

    pub(crate) fn rows(&self) -> [[f64; 3]; 3] {
        [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
    }
}
