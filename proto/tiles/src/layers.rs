//! The layers of a vector tile: which lines they show, and what they tell of each.

use nalgebra::{Point2, Vector2};

use crate::{
    BUFFER, DASHES_FROM, EXTENT, STRETCHES_FROM, TileId, VECTOR_ZOOMS, WHOLE_FROM,
    lattice::{Vertex, units},
    mvt::{LayerBuilder, Property, Tile},
    projected::{PlaneBox, ProjectedCell, ProjectedLine, SPAN, feature_id},
    stretches::Stretch,
};

/// A property of a layer's features.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    /// Its name.
    pub name: &'static str,
    /// What its values are.
    pub kind: FieldType,
    /// First zoom that has it.
    pub from_zoom: u8,
}

/// What the values of a property are, as TileJSON names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FieldType {
    /// `Number`
    Number,
    /// `String`
    Text,
}

/// A layer of the vector tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layer {
    /// Its name.
    pub name: &'static str,
    /// What it shows.
    pub description: &'static str,
    /// First zoom that has it.
    pub from_zoom: u8,
    /// What is told of its features, in the order in which they carry it.
    pub fields: &'static [Field],
}

const fn field(name: &'static str, kind: FieldType, from_zoom: u8) -> Field {
    Field { name, kind, from_zoom }
}

const FIRST: u8 = *VECTOR_ZOOMS.start();

/// The layers, in the order in which a tile has them.
pub const LAYERS: [Layer; 3] = [
    Layer {
        name: "lanes",
        description: "The lines of the shared map, each with what is known of it as a whole",
        from_zoom: FIRST,
        // Those that are there from afar come first.
        fields: &[
            field("category", FieldType::Text, FIRST),
            field("category_code", FieldType::Number, FIRST),
            field("drives", FieldType::Number, FIRST),
            field("existence", FieldType::Number, FIRST),
            field("lateral_sigma_m", FieldType::Number, FIRST),
            field("last_seen_s", FieldType::Number, FIRST),
            field("confirmed_s", FieldType::Number, FIRST),
            field("cell", FieldType::Text, WHOLE_FROM),
            field("lane", FieldType::Text, WHOLE_FROM),
            field("part", FieldType::Number, WHOLE_FROM),
            field("observations", FieldType::Number, WHOLE_FROM),
            field("height_sigma_m", FieldType::Number, WHOLE_FROM),
            field("first_seen_s", FieldType::Number, WHOLE_FROM),
        ],
    },
    Layer {
        name: "stretches",
        description: "The same lines, cut where what is known of them changes along them",
        from_zoom: STRETCHES_FROM,
        fields: &[
            field("lane_feature", FieldType::Number, STRETCHES_FROM),
            field("category", FieldType::Text, STRETCHES_FROM),
            field("category_code", FieldType::Number, STRETCHES_FROM),
            field("drives", FieldType::Number, STRETCHES_FROM),
            field("existence", FieldType::Number, STRETCHES_FROM),
            field("lateral_sigma_m", FieldType::Number, STRETCHES_FROM),
            field("height_sigma_m", FieldType::Number, STRETCHES_FROM),
            field("confirmed_s", FieldType::Number, STRETCHES_FROM),
        ],
    },
    Layer {
        name: "dashes",
        description: "What is painted of the lines that are dashed",
        from_zoom: DASHES_FROM,
        fields: &[
            field("category", FieldType::Text, DASHES_FROM),
            field("category_code", FieldType::Number, DASHES_FROM),
            field("existence", FieldType::Number, DASHES_FROM),
            field("cell", FieldType::Text, DASHES_FROM),
            field("lane", FieldType::Text, DASHES_FROM),
            field("part", FieldType::Number, DASHES_FROM),
        ],
    },
];

fn lane_properties<'a>(cell: &'a ProjectedCell, line: &'a ProjectedLine) -> [Property<'a>; 13] {
    let known = &line.known;
    [
        Property::Text(&known.category),
        Property::Whole(known.category_code.into()),
        Property::Whole(known.drives.into()),
        Property::Number(known.existence),
        Property::Number(known.lateral_sigma_m),
        Property::Whole(known.last_seen_s),
        Property::Whole(known.confirmed_s),
        Property::Text(cell.name()),
        Property::Text(&known.lane),
        Property::Whole(known.part.into()),
        Property::Whole(known.observations.cast_signed()),
        Property::Number(known.height_sigma_m),
        Property::Whole(known.first_seen_s),
    ]
}

fn stretch_properties<'a>(line: &'a ProjectedLine, stretch: &Stretch) -> [Property<'a>; 8] {
    [
        Property::Whole(line.known.id.cast_signed()),
        Property::Text(&line.known.category),
        Property::Whole(line.known.category_code.into()),
        Property::Whole(stretch.drives.into()),
        Property::Number(stretch.existence),
        Property::Number(stretch.lateral_sigma_m),
        Property::Number(stretch.height_sigma_m),
        Property::Whole(stretch.confirmed_s),
    ]
}

fn dash_properties<'a>(cell: &'a ProjectedCell, line: &'a ProjectedLine) -> [Property<'a>; 6] {
    let known = &line.known;
    [
        Property::Text(&known.category),
        Property::Whole(known.category_code.into()),
        Property::Number(known.existence),
        Property::Text(cell.name()),
        Property::Text(&known.lane),
        Property::Whole(known.part.into()),
    ]
}

/// The bytes of a vector tile, of the cells that it [touches](TileId::cells_touched), in their order; none where nothing is
/// in it, or its zoom is not among [`VECTOR_ZOOMS`].
#[must_use]
pub fn vector_tile<'a>(tile: TileId, cells: impl IntoIterator<Item = &'a ProjectedCell>) -> Vec<u8> {
    if !VECTOR_ZOOMS.contains(&tile.z()) {
        return Vec::new();
    }
    let names = |layer: &Layer| {
        layer.fields.iter().filter(|field| field.from_zoom <= tile.z()).map(|field| field.name).collect::<Vec<_>>()
    };
    let mut lanes = LayerBuilder::new(LAYERS[0].name, names(&LAYERS[0]));
    let mut stretches = LayerBuilder::new(LAYERS[1].name, names(&LAYERS[1]));
    let mut dashes = LayerBuilder::new(LAYERS[2].name, names(&LAYERS[2]));
    let lane_fields = names(&LAYERS[0]).len();
    for cell in cells {
        let window = Window::of(tile, cell);
        if tile.z() < WHOLE_FROM {
            for (index, vertices) in &cell.overview(tile.z()).lines {
                let line = &cell.lines()[*index];
                let mut parts = Vec::new();
                window.cut(vertices, &mut parts);
                lanes.add_line(line.known.id, &parts, &lane_properties(cell, line)[..lane_fields]);
            }
            continue;
        }
        let mut spans = Vec::new();
        for line in cell.lines() {
            line.spans_within(&window.bounds, &mut spans);
            if spans.is_empty() {
                continue;
            }
            let mut drawing = Drawing { window: &window, line, parts: Vec::new(), vertices: Vec::new() };
            if tile.z() < STRETCHES_FROM {
                drawing.draw_spans(&spans);
            } else {
                drawing.draw_stretches(&spans, &mut stretches);
            }
            lanes.add_line(line.known.id, &drawing.parts, &lane_properties(cell, line));
            if tile.z() >= DASHES_FROM && !line.dashes.is_empty() {
                drawing.draw_dashes(&spans);
                dashes.add_line(line.known.id, &drawing.parts, &dash_properties(cell, line));
            }
        }
    }
    let layers: Vec<_> = [lanes.finish(), stretches.finish(), dashes.finish()].into_iter().flatten().collect();
    prost::Message::encode_to_vec(&Tile { layers })
}

/// What a tile shows of the lattice: its square and the buffer around it.
struct Window {
    zoom: u8,
    corner: Vertex,
    bounds: PlaneBox,
}

impl Window {
    /// The window of a tile as a cell sees it, which may lie on the other side of the antimeridian.
    fn of(tile: TileId, cell: &ProjectedCell) -> Self {
        let side = 1_i64 << tile.z();
        let cell_column = f64::from(cell.cell().x()) + 0.5;
        let column = (f64::from(tile.x()) + 0.5) / side as f64 * f64::from(1_u32 << lanemap_core::fleet::cell::ZOOM);
        let half_way_round = f64::from(1_u32 << (lanemap_core::fleet::cell::ZOOM - 1));
        let turns = i64::from(cell_column - column > half_way_round) - i64::from(column - cell_column > half_way_round);
        let [x, y] = tile.corner();
        let corner = [x + turns * side * i64::from(EXTENT), y];
        let units = units(tile.z());
        let low = Point2::new(corner[0] as f64, corner[1] as f64) - Vector2::repeat(f64::from(BUFFER));
        let high = low + Vector2::repeat(f64::from(EXTENT + 2 * BUFFER));
        Self { zoom: tile.z(), corner, bounds: PlaneBox::new(low / units, high / units) }
    }

    /// The parts of a line that the window shows, relative to the tile's corner. Lines have vertices where they cross its
    /// edge, so that none is cut between two.
    fn cut(&self, vertices: &[Vertex], parts: &mut Vec<Vec<Vertex>>) {
        let shown = |from: Vertex, to: Vertex| {
            (0..2).all(|axis| {
                // Twice the middle of the chord, so that it is a whole number.
                let middle = from[axis] + to[axis] - 2 * self.corner[axis];
                let buffer = i64::from(BUFFER);
                (-2 * buffer..=2 * (i64::from(EXTENT) + buffer)).contains(&middle)
            })
        };
        let relative = |vertex: Vertex| [vertex[0] - self.corner[0], vertex[1] - self.corner[1]];
        let mut goes_on = false;
        for pair in vertices.windows(2) {
            let is_shown = shown(pair[0], pair[1]);
            match parts.last_mut() {
                Some(part) if is_shown && goes_on => part.push(relative(pair[1])),
                _ if is_shown => parts.push(vec![relative(pair[0]), relative(pair[1])]),
                _ => {}
            }
            goes_on = is_shown;
        }
    }
}

/// One line as it is drawn in a window.
struct Drawing<'w, 'a> {
    window: &'w Window,
    line: &'a ProjectedLine,
    parts: Vec<Vec<Vertex>>,
    /// Vertices of what is being drawn.
    vertices: Vec<Vertex>,
}

impl<'a> Drawing<'_, 'a> {
    fn draw_spans(&mut self, spans: &[[usize; 2]]) {
        for [from, to] in spans {
            self.vertices.clear();
            self.append(*from, *to);
            self.window.cut(&self.vertices, &mut self.parts);
        }
    }

    /// Draws the line, and each stretch of it, through the same vertices.
    fn draw_stretches(&mut self, spans: &[[usize; 2]], layer: &mut LayerBuilder<'a>) {
        // A stretch that leaves the window and comes back is one feature of several parts.
        let mut drawn: Vec<(&Stretch, Vec<Vec<Vertex>>)> = Vec::new();
        for [from, to] in spans {
            self.vertices.clear();
            for stretch in self.line.stretches.iter().filter(|stretch| stretch.from < *to && stretch.to > *from) {
                let begins = self.vertices.len().saturating_sub(1);
                self.append(stretch.from.max(*from), stretch.to.min(*to));
                if drawn.last().is_none_or(|(last, _)| *last != stretch) {
                    drawn.push((stretch, Vec::new()));
                }
                if let Some((_, parts)) = drawn.last_mut() {
                    self.window.cut(&self.vertices[begins..], parts);
                }
            }
            self.window.cut(&self.vertices, &mut self.parts);
        }
        for (stretch, parts) in drawn {
            let id = feature_id(&format!("{}.{}", self.line.known.id, stretch.from));
            layer.add_line(id, &parts, &stretch_properties(self.line, stretch));
        }
    }

    /// Draws the dashes that may enter the window, each whole, in place of what was drawn before.
    fn draw_dashes(&mut self, spans: &[[usize; 2]]) {
        self.parts.clear();
        let dashes = &self.line.dashes;
        for [from, to] in spans.iter().map(|span| span.map(|index| index as f64)) {
            let first = dashes.partition_point(|dash| dash[1] <= from);
            for dash in dashes[first..].iter().take_while(|dash| dash[0] < to) {
                self.vertices.clear();
                self.line.curve().append_part(*dash, self.window.zoom, &mut self.vertices);
                self.window.cut(&self.vertices, &mut self.parts);
            }
        }
    }

    /// Appends vertices from one control point to another, with vertices at all those between where spans meet.
    fn append(&mut self, from: usize, to: usize) {
        let mut start = from;
        while start < to {
            let end = ((start / SPAN + 1) * SPAN).min(to);
            self.line.curve().append_vertices(start, end, self.window.zoom, &mut self.vertices);
            start = end;
        }
    }
}
