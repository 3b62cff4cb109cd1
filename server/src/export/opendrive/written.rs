//! Elements of an OpenDRIVE file.

use std::io::{self, Write};

use nalgebra::Point3;
use quick_xml::{
    Writer,
    events::{BytesCData, BytesDecl, Event},
};

use super::{
    Geometry,
    profile::{Piece, goes_on},
};
use crate::export::map_line::{Cubic, MapLines};

/// A number as an attribute has it: to the last bit, without an exponent.
pub(super) fn attribute(value: f64) -> String {
    // Adding zero turns -0.0 into 0.0.
    format!("{}", value + 0.0)
}

/// The document around its content.
pub(super) fn document<W: Write>(
    writer: &mut Writer<W>,
    content: impl FnOnce(&mut Writer<W>) -> io::Result<()>,
) -> io::Result<()> {
    writer.write_event(Event::Decl(BytesDecl::new("1.0", Some("UTF-8"), None)))?;
    writer.create_element("OpenDRIVE").write_inner_content(content).map(drop)
}

/// The header, with the box around all lines and where on the earth they are.
pub(super) fn write_header<W: Write>(writer: &mut Writer<W>, map: &MapLines) -> io::Result<()> {
    let points = || map.lines.iter().flat_map(|line| line.segments.iter().map(|cubic| cubic.point(1.0)));
    let start = || Point3::from([f64::INFINITY; 3]);
    let (low, high) = points().fold((start(), -start()), |(low, high), point| (low.inf(&point), high.sup(&point)));
    let side = |value: f64| attribute(if value.is_finite() { value } else { 0.0 });
    let (north, south, east, west) = (side(high.y), side(low.y), side(high.x), side(low.x));
    let attributes = [
        ("revMajor", "1"),
        ("revMinor", "7"),
        ("name", "lanemap"),
        ("version", "1"),
        ("north", north.as_str()),
        ("south", south.as_str()),
        ("east", east.as_str()),
        ("west", west.as_str()),
        ("vendor", "lanemap"),
    ];
    writer
        .create_element("header")
        .with_attributes(attributes)
        .write_inner_content(|writer| {
            let proj = map.plane.proj_string();
            writer.create_element("geoReference").write_cdata_content(BytesCData::new(proj)).map(drop)
        })
        .map(drop)
}

/// A segment as `paramPoly3` in its own frame: along its first direction, and to the left of it.
pub(super) fn geometry<W: Write>(writer: &mut Writer<W>, geometry: &Geometry) -> io::Result<()> {
    let Cubic([start, b, c, d]) = &geometry.cubic;
    let heading = b.xy().try_normalize(1e-6).unwrap_or_else(|| {
        let chord = geometry.cubic.point(1.0) - geometry.cubic.point(0.0);
        chord.xy().try_normalize(1e-9).unwrap_or_else(nalgebra::Vector2::x)
    });
    let along = |vector: &nalgebra::Vector3<f64>| attribute(vector.xy().dot(&heading));
    let aside = |vector: &nalgebra::Vector3<f64>| attribute(heading.x * vector.y - heading.y * vector.x);
    let place = [
        ("s", attribute(geometry.s_m)),
        ("x", attribute(start.x)),
        ("y", attribute(start.y)),
        ("hdg", attribute(heading.y.atan2(heading.x))),
        ("length", attribute(geometry.length_m)),
    ];
    let coefficients = [
        ("aU", attribute(0.0)),
        ("bU", along(b)),
        ("cU", along(c)),
        ("dU", along(d)),
        ("aV", attribute(0.0)),
        ("bV", aside(b)),
        ("cV", aside(c)),
        ("dV", aside(d)),
        ("pRange", "normalized".to_owned()),
    ];
    let element = writer.create_element("geometry").with_attributes(place.iter().map(|(k, v)| (*k, v.as_str())));
    element
        .write_inner_content(|writer| {
            let attributes = coefficients.iter().map(|(k, v)| (*k, v.as_str()));
            writer.create_element("paramPoly3").with_attributes(attributes).write_empty().map(drop)
        })
        .map(drop)
}

/// Cubics over the way, each as an element whose ways count from `from_m`.
pub(super) fn write_cubics<W: Write>(
    writer: &mut Writer<W>,
    element: &str,
    way: &str,
    pieces: &[Piece],
    from_m: f64,
) -> io::Result<()> {
    let mut last: Option<&Piece> = None;
    for piece in pieces {
        // What only says that the piece before goes on is left out.
        if last.is_some_and(|last| goes_on(last, piece)) {
            continue;
        }
        last = Some(piece);
        let [a, b, c, d] = piece.coefficients.map(attribute);
        let s = attribute((piece.s_m - from_m).max(0.0));
        let attributes =
            [(way, s.as_str()), ("a", a.as_str()), ("b", b.as_str()), ("c", c.as_str()), ("d", d.as_str())];
        writer.create_element(element).with_attributes(attributes).write_empty()?;
    }
    Ok(())
}
