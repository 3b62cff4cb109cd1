//! What a lane line is painted as: OpenLane's categories, which are the field's common code.

use serde::{Deserialize, Serialize};

/// The kind of a lane line. The discriminant is OpenLane's code.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[repr(u8)]
pub enum Category {
    /// Not known, or none of the below.
    #[default]
    Unknown = 0,
    /// Single dashed line, white.
    WhiteDashed = 1,
    /// Single solid line, white.
    WhiteSolid = 2,
    /// Double dashed line, white.
    DoubleWhiteDashed = 3,
    /// Double solid line, white.
    DoubleWhiteSolid = 4,
    /// White, dashed on the left and solid on the right.
    WhiteLeftDashedRightSolid = 5,
    /// White, solid on the left and dashed on the right.
    WhiteLeftSolidRightDashed = 6,
    /// Single dashed line, yellow.
    YellowDashed = 7,
    /// Single solid line, yellow.
    YellowSolid = 8,
    /// Double dashed line, yellow.
    DoubleYellowDashed = 9,
    /// Double solid line, yellow.
    DoubleYellowSolid = 10,
    /// Yellow, dashed on the left and solid on the right.
    YellowLeftDashedRightSolid = 11,
    /// Yellow, solid on the left and dashed on the right.
    YellowLeftSolidRightDashed = 12,
    /// The curb on the left side of the road.
    LeftCurb = 20,
    /// The curb on the right side of the road.
    RightCurb = 21,
}

impl Category {
    /// Every category, in the order of its code.
    pub const ALL: [Self; 15] = [
        Self::Unknown,
        Self::WhiteDashed,
        Self::WhiteSolid,
        Self::DoubleWhiteDashed,
        Self::DoubleWhiteSolid,
        Self::WhiteLeftDashedRightSolid,
        Self::WhiteLeftSolidRightDashed,
        Self::YellowDashed,
        Self::YellowSolid,
        Self::DoubleYellowDashed,
        Self::DoubleYellowSolid,
        Self::YellowLeftDashedRightSolid,
        Self::YellowLeftSolidRightDashed,
        Self::LeftCurb,
        Self::RightCurb,
    ];

    /// OpenLane's code of this category.
    #[must_use]
    pub const fn openlane_code(self) -> u8 {
        self as u8
    }

    /// The category of an OpenLane code, or `None` where OpenLane names no such code.
    #[must_use]
    pub fn from_openlane_code(code: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|category| category.openlane_code() == code)
    }

    /// Position in [`Category::ALL`], for tables indexed by category.
    #[must_use]
    pub const fn index(self) -> usize {
        match self {
            Self::LeftCurb => 13,
            Self::RightCurb => 14,
            other => other as usize,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_category_survives_its_openlane_code_and_its_index() {
        for (index, category) in Category::ALL.into_iter().enumerate() {
            assert_eq!(Category::from_openlane_code(category.openlane_code()), Some(category));
            assert_eq!(category.index(), index);
        }
        assert_eq!(Category::from_openlane_code(13), None);
    }
}
