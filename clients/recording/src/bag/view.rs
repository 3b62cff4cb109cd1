//! A message of a bag, read through its definition: nothing is copied, nothing is built.

use super::definition::{Definitions, Field, Kind, Primitive, ROOT};

/// A value within a message: its type, and exactly its bytes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View<'a> {
    definitions: &'a Definitions,
    kind: &'a Kind,
    bytes: &'a [u8],
}

/// Where a message does not hold what its definition says.
pub(crate) type Torn = String;

/// The message of a definition in `bytes`.
pub(crate) fn message<'a>(definitions: &'a Definitions, bytes: &'a [u8]) -> Result<View<'a>, Torn> {
    let size = measure(definitions, &ROOT, bytes)?;
    if size != bytes.len() {
        return Err(format!("has {} bytes, its definition accounts for {size}", bytes.len()));
    }
    Ok(View { definitions, kind: &ROOT, bytes })
}

impl<'a> View<'a> {
    /// A field of a message; `None`: it has no such field.
    pub(crate) fn field(&self, name: &str) -> Option<Self> {
        let Kind::Message(place) = self.kind else { return None };
        let mut rest = self.bytes;
        for Field { name: here, kind } in &self.definitions.message(*place).fields {
            let size = measure(self.definitions, kind, rest).ok()?;
            let (bytes, behind) = rest.split_at_checked(size)?;
            if here == name {
                return Some(View { kind, bytes, ..*self });
            }
            rest = behind;
        }
        None
    }

    /// The elements of a list; none where it is no list.
    pub(crate) fn elements(&self) -> impl Iterator<Item = View<'a>> + use<'a> {
        let (definitions, mut rest, mut left, element) = match self.kind {
            Kind::List(element, Some(length)) => (self.definitions, self.bytes, *length, &**element),
            Kind::List(element, None) => match self.bytes.split_first_chunk() {
                Some((length, rest)) => (self.definitions, rest, u32::from_le_bytes(*length) as usize, &**element),
                None => (self.definitions, self.bytes, 0, &**element),
            },
            kind => (self.definitions, self.bytes, 0, kind),
        };
        std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let size = measure(definitions, element, rest).ok()?;
            let (bytes, behind) = rest.split_at_checked(size)?;
            rest = behind;
            Some(View { definitions, kind: element, bytes })
        })
    }

    /// A number.
    pub(crate) fn number(&self) -> Option<f64> {
        let Kind::Primitive(primitive) = self.kind else { return None };
        match primitive {
            Primitive::Float32 => self.array().map(f32::from_le_bytes).map(f64::from),
            Primitive::Float64 => self.array().map(f64::from_le_bytes),
            Primitive::Time | Primitive::Duration => None,
            _ => self.integer().map(|value| value as f64),
        }
    }

    /// A whole number.
    pub(crate) fn integer(&self) -> Option<i64> {
        let Kind::Primitive(primitive) = self.kind else { return None };
        match primitive {
            Primitive::Bool | Primitive::Uint8 => self.array().map(u8::from_le_bytes).map(i64::from),
            Primitive::Int8 => self.array().map(i8::from_le_bytes).map(i64::from),
            Primitive::Int16 => self.array().map(i16::from_le_bytes).map(i64::from),
            Primitive::Uint16 => self.array().map(u16::from_le_bytes).map(i64::from),
            Primitive::Int32 => self.array().map(i32::from_le_bytes).map(i64::from),
            Primitive::Uint32 => self.array().map(u32::from_le_bytes).map(i64::from),
            Primitive::Int64 => self.array().map(i64::from_le_bytes),
            Primitive::Uint64 => self.array().map(u64::from_le_bytes).and_then(|value| i64::try_from(value).ok()),
            Primitive::Float32 | Primitive::Float64 | Primitive::Time | Primitive::Duration => None,
        }
    }

    /// A time, nanoseconds since the Unix epoch.
    pub(crate) fn time_ns(&self) -> Option<i64> {
        let Kind::Primitive(Primitive::Time) = self.kind else { return None };
        self.array().map(super::records::time_ns)
    }

    fn array<const N: usize>(&self) -> Option<[u8; N]> {
        self.bytes.try_into().ok()
    }
}

/// Size of the value at the start of `bytes`.
fn measure(definitions: &Definitions, kind: &Kind, bytes: &[u8]) -> Result<usize, Torn> {
    let torn = |size: usize| format!("is torn: a {} of {size} bytes, {} are left", definitions.name(kind), bytes.len());
    let (least, fixed) = definitions.size(kind);
    if least > bytes.len() {
        return Err(torn(least));
    }
    if fixed {
        return Ok(least);
    }
    match kind {
        Kind::Primitive(primitive) => Ok(primitive.size()),
        Kind::Text => {
            let length = length_at(bytes).ok_or_else(|| torn(4))?;
            if length <= bytes.len() - 4 { Ok(4 + length) } else { Err(torn(4 + length)) }
        }
        Kind::Message(place) => definitions.message(*place).fields.iter().try_fold(0, |size, field| {
            Ok(size + measure(definitions, &field.kind, bytes.get(size..).unwrap_or_default())?)
        }),
        Kind::List(element, Some(length)) => measure_list(definitions, element, *length, bytes),
        Kind::List(element, None) => {
            let length = length_at(bytes).ok_or_else(|| torn(4))?;
            Ok(4 + measure_list(definitions, element, length, &bytes[4..])?)
        }
    }
}

fn measure_list(definitions: &Definitions, element: &Kind, length: usize, bytes: &[u8]) -> Result<usize, Torn> {
    let (least, fixed) = definitions.size(element);
    let size = length.checked_mul(least).filter(|size| *size <= bytes.len()).ok_or_else(|| {
        let name = definitions.name(element);
        format!("says that it has a list of {length} {name}, for which {} bytes are too few", bytes.len())
    })?;
    if fixed {
        return Ok(size);
    }
    (0..length).try_fold(0, |size, _| Ok(size + measure(definitions, element, bytes.get(size..).unwrap_or_default())?))
}

fn length_at(bytes: &[u8]) -> Option<usize> {
    bytes.first_chunk().map(|length| u32::from_le_bytes(*length) as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "string name\nP[] points\nint8 last\n===\nMSG: t/P\nfloat32 x\nfloat64 y\n";

    fn bytes() -> Vec<u8> {
        let mut bytes = vec![2, 0, 0, 0, b'o', b'k', 2, 0, 0, 0];
        for (x, y) in [(1.5_f32, 2.5_f64), (-3.0, 4.0)] {
            bytes.extend(x.to_le_bytes());
            bytes.extend(y.to_le_bytes());
        }
        bytes.push(0xff);
        bytes
    }

    #[test]
    fn fields_are_found_by_name_wherever_they_lie() {
        let definitions = Definitions::parse("t/M", TEXT).unwrap();
        let bytes = bytes();
        let message = message(&definitions, &bytes).unwrap();
        assert_eq!(message.field("last").unwrap().integer(), Some(-1));
        let xy = |point: View<'_>| {
            (point.field("x").unwrap().number().unwrap(), point.field("y").unwrap().number().unwrap())
        };
        let points: Vec<_> = message.field("points").unwrap().elements().map(xy).collect();
        assert_eq!(points, [(1.5, 2.5), (-3.0, 4.0)]);
        assert!(message.field("nothing").is_none());
    }

    #[test]
    fn a_message_that_is_torn_or_says_an_absurd_length_is_refused() {
        let definitions = Definitions::parse("t/M", TEXT).unwrap();
        let whole = bytes();
        for cut in 0..whole.len() {
            assert!(message(&definitions, &whole[..cut]).is_err(), "{cut}");
        }
        let mut absurd = whole.clone();
        absurd[6..10].copy_from_slice(&u32::MAX.to_le_bytes());
        let error = message(&definitions, &absurd).unwrap_err();
        assert!(error.contains("list of 4294967295 t/P"), "{error}");
        let longer = [whole.as_slice(), &[0]].concat();
        assert!(message(&definitions, &longer).unwrap_err().contains("accounts for"));
    }
}
