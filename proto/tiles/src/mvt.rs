//! Mapbox Vector Tile 2.1: its messages, and a layer that is filled feature by feature.
//!
//! The messages are those of `vector_tile.proto` of the specification. The crate `mvt` looks every value up in a list,
//! which costs the square of a layer's values; here they are looked up by their hash.

use std::collections::HashMap;

use crate::{EXTENT, lattice::Vertex};

/// A tile.
#[derive(Clone, PartialEq, prost::Message)]
pub struct Tile {
    /// Its layers.
    #[prost(message, repeated, tag = "3")]
    pub layers: Vec<Layer>,
}

/// A layer.
#[derive(Clone, PartialEq, prost::Message)]
pub struct Layer {
    /// Version of the specification: 2.
    #[prost(uint32, required, tag = "15")]
    pub version: u32,
    /// Its name.
    #[prost(string, required, tag = "1")]
    pub name: String,
    /// Its features.
    #[prost(message, repeated, tag = "2")]
    pub features: Vec<Feature>,
    /// Names of properties.
    #[prost(string, repeated, tag = "3")]
    pub keys: Vec<String>,
    /// Values of properties, each once.
    #[prost(message, repeated, tag = "4")]
    pub values: Vec<Value>,
    /// Units along the side of the tile.
    #[prost(uint32, optional, tag = "5")]
    pub extent: Option<u32>,
}

/// A feature.
#[derive(Clone, PartialEq, prost::Message)]
pub struct Feature {
    /// Unique within its layer.
    #[prost(uint64, optional, tag = "1")]
    pub id: Option<u64>,
    /// Pairs of indices into the layer's keys and values.
    #[prost(uint32, repeated, tag = "2")]
    pub tags: Vec<u32>,
    /// 2: a line.
    #[prost(int32, optional, tag = "3")]
    pub kind: Option<i32>,
    /// Commands.
    #[prost(uint32, repeated, tag = "4")]
    pub geometry: Vec<u32>,
}

/// A value, one of its fields.
#[derive(Clone, PartialEq, prost::Message)]
pub struct Value {
    /// A text.
    #[prost(string, optional, tag = "1")]
    pub string: Option<String>,
    /// A number.
    #[prost(double, optional, tag = "3")]
    pub double: Option<f64>,
    /// A whole number.
    #[prost(int64, optional, tag = "4")]
    pub int: Option<i64>,
}

/// The kind of features that are lines.
const LINE: i32 = 2;

/// A property's value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Property<'a> {
    /// A text.
    Text(&'a str),
    /// A number.
    Number(f64),
    /// A whole number.
    Whole(i64),
}

/// A value as it is told from others.
#[derive(PartialEq, Eq, Hash)]
enum Known<'a> {
    Text(&'a str),
    Bits(u64),
    Whole(i64),
}

/// A layer that is being filled.
pub struct LayerBuilder<'a> {
    layer: Layer,
    known: HashMap<Known<'a>, u32>,
}

impl<'a> LayerBuilder<'a> {
    /// An empty layer whose features have these properties.
    #[must_use]
    pub fn new(name: &str, keys: impl IntoIterator<Item = &'static str>) -> Self {
        let keys = keys.into_iter().map(str::to_owned).collect();
        let layer = Layer { version: 2, name: name.to_owned(), keys, extent: Some(EXTENT), ..Layer::default() };
        Self { layer, known: HashMap::new() }
    }

    /// Adds a line with its properties, in the order of the layer's keys. Vertices are relative to the tile's corner; a part
    /// with fewer than two of them is left out, and the line where no part is left.
    pub fn add_line(&mut self, id: u64, parts: &[Vec<Vertex>], properties: &[Property<'a>]) {
        let geometry = commands(parts);
        if geometry.is_empty() {
            return;
        }
        let mut tags = Vec::with_capacity(2 * properties.len());
        for (key, property) in (0..).zip(properties) {
            tags.extend([key, self.value(*property)]);
        }
        self.layer.features.push(Feature { id: Some(id), tags, kind: Some(LINE), geometry });
    }

    fn value(&mut self, property: Property<'a>) -> u32 {
        let known = match property {
            Property::Text(text) => Known::Text(text),
            Property::Number(number) => Known::Bits(number.to_bits()),
            Property::Whole(number) => Known::Whole(number),
        };
        let values = &mut self.layer.values;
        *self.known.entry(known).or_insert_with(|| {
            let value = match property {
                Property::Text(text) => Value { string: Some(text.to_owned()), ..Value::default() },
                Property::Number(number) => Value { double: Some(number), ..Value::default() },
                Property::Whole(number) => Value { int: Some(number), ..Value::default() },
            };
            values.push(value);
            u32::try_from(values.len() - 1).unwrap_or(u32::MAX)
        })
    }

    /// The layer, where it has features: an empty one is not allowed in a tile.
    #[must_use]
    pub fn finish(self) -> Option<Layer> {
        (!self.layer.features.is_empty()).then_some(self.layer)
    }
}

/// The commands that draw some lines: move to the first vertex, lines to all others.
fn commands(parts: &[Vec<Vertex>]) -> Vec<u32> {
    const MOVE_TO: u32 = 1;
    const LINE_TO: u32 = 2;
    let parts = || parts.iter().filter(|part| part.len() > 1);
    let mut commands = Vec::with_capacity(parts().map(|part| 2 * part.len() + 2).sum());
    let mut cursor = [0, 0];
    for part in parts() {
        commands.push(MOVE_TO | 1 << 3);
        for (index, vertex) in part.iter().enumerate() {
            if index == 1 {
                commands.push(LINE_TO | u32::try_from(part.len() - 1).unwrap_or(u32::MAX >> 3) << 3);
            }
            commands.extend([0, 1].map(|axis| zigzag(vertex[axis] - cursor[axis])));
            cursor = *vertex;
        }
    }
    commands
}

#[expect(clippy::cast_possible_truncation, reason = "vertices of a tile lie within its buffer")]
fn zigzag(step: i64) -> u32 {
    let step = step as i32;
    ((step << 1) ^ (step >> 31)).cast_unsigned()
}

/// The parts of a feature, vertices relative to the tile's corner; `None` where the commands are no lines.
#[must_use]
pub fn line_parts(feature: &Feature) -> Option<Vec<Vec<Vertex>>> {
    let mut commands = feature.geometry.iter();
    let (mut parts, mut cursor): (Vec<Vec<Vertex>>, Vertex) = (Vec::new(), [0, 0]);
    while let Some(command) = commands.next() {
        let count = command >> 3;
        for _ in 0..count {
            for axis in &mut cursor {
                let step = *commands.next()?;
                *axis += i64::from((step >> 1).cast_signed() ^ -(step & 1).cast_signed());
            }
            match command & 7 {
                1 => parts.push(vec![cursor]),
                2 => parts.last_mut()?.push(cursor),
                _ => return None,
            }
        }
    }
    Some(parts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_drawn_as_the_specification_does() {
        // The two lines of its section 4.3.5.4.
        let parts = [vec![[2, 2], [2, 10], [10, 10]], vec![[1, 1], [3, 5]]];
        assert_eq!(commands(&parts), [9, 4, 4, 18, 0, 16, 16, 0, 9, 17, 17, 10, 4, 8]);
    }

    #[test]
    fn values_stand_once_and_lines_without_a_vertex_are_left_out() {
        let mut layer = LayerBuilder::new("lanes", ["a", "b"]);
        let line = [vec![[0, 0], [5, 5]]];
        layer.add_line(1, &line, &[Property::Text("x"), Property::Number(0.5)]);
        layer.add_line(2, &line, &[Property::Text("x"), Property::Number(0.25)]);
        layer.add_line(3, &[vec![[1, 1]]], &[Property::Text("y"), Property::Number(0.5)]);
        let layer = layer.finish().unwrap();
        assert_eq!((layer.features.len(), layer.values.len()), (2, 3));
        assert_eq!(layer.features[1].tags, [0, 0, 1, 2]);
        assert_eq!(line_parts(&layer.features[0]), Some(line.to_vec()));
    }

    #[test]
    fn a_layer_without_features_is_none() {
        assert_eq!(LayerBuilder::new("lanes", []).finish(), None);
    }
}
