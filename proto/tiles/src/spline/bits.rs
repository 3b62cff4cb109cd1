//! Strings of bits, and the numbers in them: `u(n)`, `e(k)` and `s(k)` of `lanemap/v1/spline_tile.proto`.

/// A string of bits that grows. The first bit of a byte is its highest.
#[derive(Debug, Default)]
pub(super) struct BitWriter {
    bytes: Vec<u8>,
    /// Bits of the last byte that are taken, 0 to 7; at 0 there is no unfinished byte.
    taken: u32,
}

impl BitWriter {
    /// `u(count)`: the low bits of a number, the highest first.
    pub(super) fn bits(&mut self, value: u64, count: u32) {
        for bit in (0..count).rev() {
            if self.taken == 0 {
                self.bytes.push(0);
            }
            if let Some(last) = self.bytes.last_mut() {
                *last |= u8::from(value >> bit & 1 == 1) << (7 - self.taken);
            }
            self.taken = (self.taken + 1) % 8;
        }
    }

    pub(super) fn flag(&mut self, value: bool) {
        self.bits(u64::from(value), 1);
    }

    /// `e(order)`: an Exp-Golomb code, short for numbers up to about `2^order`. The number must be below `2^62`.
    pub(super) fn unsigned(&mut self, value: u64, order: u32) {
        let shifted = value + (1 << order);
        let extra = shifted.ilog2() - order;
        self.bits(0, extra);
        // The leading one of the number ends the zeros.
        self.bits(shifted, extra + order + 1);
    }

    /// `s(order)`: the same for numbers of either sign: 0, -1, 1, -2, 2 ...
    pub(super) fn signed(&mut self, value: i64, order: u32) {
        self.unsigned(((value << 1) ^ (value >> 63)).cast_unsigned(), order);
    }

    /// The bytes; what is left of the last one is zero.
    pub(super) fn finish(self) -> Vec<u8> {
        self.bytes
    }
}

/// Bits `signed` takes for a number.
pub(super) fn signed_cost(value: i64, order: u32) -> u32 {
    let shifted = ((value << 1) ^ (value >> 63)).cast_unsigned() + (1 << order);
    2 * (shifted.ilog2() - order) + order + 1
}

/// Reads a string of bits. Every reading is `None` where the string ends within it.
#[derive(Debug)]
pub(super) struct BitReader<'a> {
    bytes: &'a [u8],
    next: usize,
}

impl<'a> BitReader<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, next: 0 }
    }

    pub(super) fn bits(&mut self, count: u32) -> Option<u64> {
        let mut value = 0;
        for _ in 0..count {
            let byte = self.bytes.get(self.next / 8)?;
            value = value << 1 | u64::from(byte >> (7 - self.next % 8) & 1);
            self.next += 1;
        }
        Some(value)
    }

    pub(super) fn flag(&mut self) -> Option<bool> {
        Some(self.bits(1)? == 1)
    }

    pub(super) fn unsigned(&mut self, order: u32) -> Option<u64> {
        let mut extra = 0;
        while self.bits(1)? == 0 {
            extra += 1;
            if extra + order > 61 {
                return None;
            }
        }
        Some((self.bits(extra + order)? | 1 << (extra + order)) - (1 << order))
    }

    pub(super) fn signed(&mut self, order: u32) -> Option<i64> {
        let value = self.unsigned(order)?;
        Some((value >> 1).cast_signed() ^ -(value & 1).cast_signed())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn numbers_survive_their_code(numbers in prop::collection::vec((-1_i64 << 40..1 << 40, 0..20_u32), 0..40)) {
            let mut writer = BitWriter::default();
            for (number, order) in &numbers {
                writer.signed(*number, *order);
                writer.unsigned(number.unsigned_abs(), *order);
            }
            let bytes = writer.finish();
            let mut reader = BitReader::new(&bytes);
            for (number, order) in &numbers {
                prop_assert_eq!(reader.signed(*order), Some(*number));
                prop_assert_eq!(reader.unsigned(*order), Some(number.unsigned_abs()));
            }
        }

        #[test]
        fn any_bytes_are_read_to_their_end(bytes in prop::collection::vec(any::<u8>(), 0..40), order in 0..20_u32) {
            let mut reader = BitReader::new(&bytes);
            while reader.signed(order).is_some() {}
        }
    }

    #[test]
    fn codes_are_as_the_protocol_describes_them() {
        let mut writer = BitWriter::default();
        writer.unsigned(0, 0); // 1
        writer.unsigned(2, 0); // 0 1 1
        writer.unsigned(5, 1); // 0 0 1 1 1? 5 + 2 = 7 = 111 binary, one extra bit: 0 1 1 1
        assert_eq!(writer.finish(), [0b1011_0111]);
    }
}
