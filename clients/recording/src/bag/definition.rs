//! The message definitions that a bag holds.
//!
//! A definition is the text of a `.msg` file, followed by those of the messages that it names, each after a line of `=` and
//! a line `MSG: package/Type`. It is resolved as a whole: a definition that exists names only types that it holds, and does
//! not hold itself.

use std::collections::BTreeMap;

use thiserror::Error;

/// Longest text of a definition, bytes.
const MAX_TEXT_BYTES: usize = 1 << 20;
/// Most messages in a definition.
const MAX_TYPES: usize = 256;
/// Most fields in a message.
const MAX_FIELDS: usize = 1024;
/// Deepest nesting of messages.
const MAX_DEPTH: usize = 16;
/// Least and greatest size of a message, bytes, are counted up to here.
const MAX_SIZE: usize = 1 << 30;

/// Why a definition is not taken.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("message definition of {kind}, line {line}: {problem}")]
pub struct DefinitionError {
    /// The message.
    pub kind: String,
    /// Line of the whole text, from 1; 0: none in particular.
    pub line: usize,
    /// What is wrong.
    pub problem: String,
}

/// A number on the wire, little-endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Primitive {
    Bool,
    Int8,
    Uint8,
    Int16,
    Uint16,
    Int32,
    Uint32,
    Int64,
    Uint64,
    Float32,
    Float64,
    /// Seconds and nanoseconds, unsigned.
    Time,
    /// Seconds and nanoseconds, signed.
    Duration,
}

/// What a field holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Primitive(Primitive),
    Text,
    /// Place of the message in [`Definitions::types`].
    Message(usize),
    /// A list; `None`: its length stands before it.
    List(Box<Kind>, Option<usize>),
}

/// A field of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Field {
    pub(crate) name: String,
    pub(crate) kind: Kind,
}

/// A message: its fields in the order of the wire.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct MessageType {
    pub(crate) name: String,
    pub(crate) fields: Vec<Field>,
    /// Least size on the wire, bytes.
    least: usize,
    /// Whether every such message has that size.
    fixed: bool,
}

/// The message of a definition itself.
pub(crate) static ROOT: Kind = Kind::Message(0);

/// A definition: a message and all that it is made of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Definitions {
    /// The message itself first.
    types: Vec<MessageType>,
}

impl Primitive {
    fn named(name: &str) -> Option<Self> {
        Some(match name {
            "bool" => Self::Bool,
            "int8" | "byte" => Self::Int8,
            "uint8" | "char" => Self::Uint8,
            "int16" => Self::Int16,
            "uint16" => Self::Uint16,
            "int32" => Self::Int32,
            "uint32" => Self::Uint32,
            "int64" => Self::Int64,
            "uint64" => Self::Uint64,
            "float32" => Self::Float32,
            "float64" => Self::Float64,
            "time" => Self::Time,
            "duration" => Self::Duration,
            _ => return None,
        })
    }

    pub(crate) fn size(self) -> usize {
        match self {
            Self::Bool | Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 => 4,
            Self::Int64 | Self::Uint64 | Self::Float64 | Self::Time | Self::Duration => 8,
        }
    }
}

/// A field as it is written, its type not looked up yet.
struct WrittenField<'a> {
    line: usize,
    kind: &'a str,
    name: &'a str,
}

struct WrittenType<'a> {
    name: &'a str,
    fields: Vec<WrittenField<'a>>,
}

impl Definitions {
    /// Parses the definition of the message `kind`, e.g. `openlane_bag/LaneList`.
    ///
    /// # Errors
    /// A line that is no field, a type that the text does not hold, a message that holds itself, or a text, message or
    /// nesting beyond the limits.
    pub fn parse(kind: &str, text: &str) -> Result<Self, DefinitionError> {
        let refuse = |line, problem: String| DefinitionError { kind: shown(kind), line, problem };
        if text.len() > MAX_TEXT_BYTES {
            return Err(refuse(0, format!("has {} bytes, limit {MAX_TEXT_BYTES}", text.len())));
        }
        let written = sections(kind, text).map_err(|(line, problem)| refuse(line, problem))?;
        let places: BTreeMap<&str, usize> = written.iter().enumerate().rev().map(|(i, w)| (w.name, i)).collect();
        let mut types = Vec::with_capacity(written.len());
        for message in &written {
            let fields = message.fields.iter().map(|field| {
                let kind = resolve(field.kind, message.name, &places).map_err(|problem| refuse(field.line, problem))?;
                Ok(Field { name: field.name.to_owned(), kind })
            });
            let fields = fields.collect::<Result<_, DefinitionError>>()?;
            types.push(MessageType { name: message.name.to_owned(), fields, ..MessageType::default() });
        }
        let mut definitions = Self { types };
        let mut measured = vec![false; definitions.types.len()];
        for place in 0..definitions.types.len() {
            definitions.measure(place, 0, &mut measured).map_err(|problem| refuse(0, problem))?;
        }
        Ok(definitions)
    }

    /// Whether `bytes` are exactly one message of this definition.
    ///
    /// # Errors
    /// What of it is torn, or how many bytes are too many.
    pub fn check(&self, bytes: &[u8]) -> Result<(), String> {
        super::view::message(self, bytes).map(drop)
    }

    pub(crate) fn message(&self, place: usize) -> &MessageType {
        &self.types[place]
    }

    /// Least size of a value on the wire, bytes, and whether every value has it.
    pub(crate) fn size(&self, kind: &Kind) -> (usize, bool) {
        match kind {
            Kind::Primitive(primitive) => (primitive.size(), true),
            Kind::Text | Kind::List(_, None) => (4, false),
            Kind::Message(place) => (self.types[*place].least, self.types[*place].fixed),
            Kind::List(element, Some(length)) => {
                let (least, fixed) = self.size(element);
                (least.saturating_mul(*length).min(MAX_SIZE), fixed)
            }
        }
    }

    /// A type in the words of a definition.
    pub(crate) fn name(&self, kind: &Kind) -> String {
        match kind {
            Kind::Primitive(primitive) => format!("{primitive:?}").to_lowercase(),
            Kind::Text => "string".to_owned(),
            Kind::Message(place) => self.types[*place].name.clone(),
            Kind::List(element, None) => format!("{}[]", self.name(element)),
            Kind::List(element, Some(length)) => format!("{}[{length}]", self.name(element)),
        }
    }

    /// Sizes the message at `place` after those that it holds.
    fn measure(&mut self, place: usize, depth: usize, measured: &mut [bool]) -> Result<(), String> {
        if measured[place] {
            return Ok(());
        }
        if depth > MAX_DEPTH {
            let name = shown(&self.types[place].name);
            return Err(format!("{name} holds itself, or is nested deeper than {MAX_DEPTH}"));
        }
        for index in 0..self.types[place].fields.len() {
            if let Some(inner) = held(&self.types[place].fields[index].kind) {
                self.measure(inner, depth + 1, measured)?;
            }
        }
        let (mut least, mut fixed) = (0_usize, true);
        for field in &self.types[place].fields {
            if let Kind::List(element, _) = &field.kind
                && self.size(element).0 == 0
            {
                let (name, field) = (shown(&self.types[place].name), shown(&field.name));
                return Err(format!("{name}.{field} is a list of messages without any field"));
            }
            let (size, is_fixed) = self.size(&field.kind);
            least = least.saturating_add(size).min(MAX_SIZE);
            fixed &= is_fixed;
        }
        let message = &mut self.types[place];
        // A size that was capped is not the size.
        (message.least, message.fixed) = (least, fixed && least < MAX_SIZE);
        measured[place] = true;
        Ok(())
    }
}

/// The message that a field holds, itself or in a list.
fn held(kind: &Kind) -> Option<usize> {
    match kind {
        Kind::Message(place) => Some(*place),
        Kind::List(element, _) => held(element),
        Kind::Primitive(_) | Kind::Text => None,
    }
}

/// Cuts the text into its messages.
fn sections<'a>(kind: &'a str, text: &'a str) -> Result<Vec<WrittenType<'a>>, (usize, String)> {
    let mut types = vec![WrittenType { name: kind, fields: Vec::new() }];
    let mut after_rule = false;
    for (index, line) in text.lines().enumerate() {
        let number = index + 1;
        let line = line.trim();
        if line.len() >= 3 && line.bytes().all(|byte| byte == b'=') {
            after_rule = true;
            continue;
        }
        if let Some(name) = line.strip_prefix("MSG:").filter(|_| after_rule) {
            if types.len() == MAX_TYPES {
                return Err((number, format!("more than {MAX_TYPES} messages")));
            }
            types.push(WrittenType { name: name.trim(), fields: Vec::new() });
            after_rule = false;
            continue;
        }
        let Some(field) = field_of(line, number).map_err(|problem| (number, problem))? else { continue };
        let Some(current) = types.last_mut() else { continue };
        if current.fields.len() == MAX_FIELDS {
            return Err((number, format!("{} has more than {MAX_FIELDS} fields", shown(current.name))));
        }
        current.fields.push(field);
    }
    Ok(types)
}

/// The field of a line; `None`: an empty line, a comment, or a constant, which is not on the wire.
fn field_of(line: &str, number: usize) -> Result<Option<WrittenField<'_>>, String> {
    let code = line.split('#').next().unwrap_or_default().trim();
    if code.is_empty() {
        return Ok(None);
    }
    let (kind, name) = code.split_once(char::is_whitespace).ok_or_else(|| format!("{:?} is no field", shown(code)))?;
    let name = name.trim();
    if name.contains('=') {
        return Ok(None);
    }
    let is_name = name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    if is_name {
        Ok(Some(WrittenField { line: number, kind, name }))
    } else {
        Err(format!("{:?} is no name", shown(name)))
    }
}

/// The type that `written` names within the message `within`.
fn resolve(written: &str, within: &str, places: &BTreeMap<&str, usize>) -> Result<Kind, String> {
    if let Some((element, length)) = written.strip_suffix(']').and_then(|list| list.rsplit_once('[')) {
        let length = match length {
            "" => None,
            length => Some(length.parse().map_err(|_| format!("{:?} is no length of a list", shown(length)))?),
        };
        return match resolve(element, within, places)? {
            Kind::List(..) => Err(format!("{:?} is a list of lists", shown(written))),
            element => Ok(Kind::List(Box::new(element), length)),
        };
    }
    if let Some(primitive) = Primitive::named(written) {
        return Ok(Kind::Primitive(primitive));
    }
    if written == "string" {
        return Ok(Kind::Text);
    }
    let package = within.split_once('/').map_or("", |(package, _)| package);
    let in_package = format!("{package}/{written}");
    let candidates = if written == "Header" { ["std_msgs/Header", &in_package] } else { [written, &in_package] };
    let place = candidates.iter().find_map(|name| places.get(name));
    place.map(|place| Kind::Message(*place)).ok_or_else(|| format!("{:?} is not defined in the bag", shown(written)))
}

/// A text of a file, short enough for an error.
pub(crate) fn shown(text: &str) -> String {
    text.chars().take(64).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LANE_LIST: &str = "Header header\nLane[] lane_list  # all of them\nint32 num_lanes\n\n\
        ================================================================================\nMSG: std_msgs/Header\n\
        uint32 seq\ntime stamp\nstring frame_id\n\
        ================================================================================\nMSG: openlane_bag/Lane\n\
        int32 LEFT=1\nstring NOTE=a # no comment\nLanePoint[] lane\nint32 category\n\
        ================================================================================\nMSG: openlane_bag/LanePoint\n\
        float32 x\nfloat32 y\nfloat32 z\nfloat32 visibility\n";

    fn refusal(text: &str) -> String {
        Definitions::parse("a/B", text).unwrap_err().to_string()
    }

    #[test]
    fn the_authors_definition_resolves_into_its_messages() {
        let definitions = Definitions::parse("openlane_bag/LaneList", LANE_LIST).unwrap();
        let root = definitions.message(0);
        let names: Vec<_> =
            root.fields.iter().map(|field| (field.name.as_str(), definitions.name(&field.kind))).collect();
        let expected = [("header", "std_msgs/Header"), ("lane_list", "openlane_bag/Lane[]"), ("num_lanes", "int32")];
        assert_eq!(names, expected.map(|(name, kind)| (name, kind.to_owned())));
        assert_eq!(definitions.message(2).fields.len(), 2, "constants are not on the wire");
        assert_eq!(definitions.size(&Kind::Message(3)), (16, true));
        assert_eq!(definitions.size(&Kind::Message(1)), (16, false));
    }

    #[test]
    fn a_definition_that_is_not_whole_is_refused_by_line() {
        assert_eq!(refusal("int32 a\nLane b"), "message definition of a/B, line 2: \"Lane\" is not defined in the bag");
        assert_eq!(refusal("int32"), "message definition of a/B, line 1: \"int32\" is no field");
        assert_eq!(refusal("int32[x] a"), "message definition of a/B, line 1: \"x\" is no length of a list");
    }

    #[test]
    fn a_message_that_holds_itself_and_a_list_of_nothing_are_refused() {
        assert!(refusal("B[] b\n===\nMSG: a/B\nB[] b").contains("holds itself"));
        assert!(refusal("E[] b\n===\nMSG: a/E\nint32 X=1").contains("without any field"));
    }
}
