//! Where on the earth a drive's own frame lies: WGS84, ECEF, a local east-north-up frame, and a fit of one on the other.
