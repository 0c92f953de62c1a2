//! Numbers made of bytes.

/// Bytes not used yet. When there are none left, everything is zero.
pub struct Numbers<'a>(pub &'a [u8]);

impl Numbers<'_> {
    pub fn byte(&mut self) -> u8 {
        match self.0.split_first() {
            Some((first, rest)) => {
                self.0 = rest;
                *first
            }
            None => 0,
        }
    }

    /// Up to `most`.
    pub fn up_to(&mut self, most: usize) -> usize {
        self.byte() as usize % (most + 1)
    }

    pub fn word(&mut self) -> u64 {
        let bytes: [u8; 8] = std::array::from_fn(|_| self.byte());
        u64::from_le_bytes(bytes)
    }

    /// A number of any kind: mostly of ordinary size, sometimes a special one, sometimes any bits.
    pub fn number(&mut self) -> f64 {
        match self.byte() {
            0 => 0.0,
            1 => 1.0,
            2 => -1.0,
            3 => f64::NAN,
            4 => f64::INFINITY,
            5 => f64::NEG_INFINITY,
            6 => f64::MAX,
            7 => f64::MIN_POSITIVE,
            8 => 5e-324,
            9 => 1e308,
            10 => f64::EPSILON,
            11..=30 => f64::from_bits(self.word()),
            _ => self.ordinary(),
        }
    }

    /// Between -4 and 4.
    pub fn ordinary(&mut self) -> f64 {
        f64::from(i16::from_le_bytes([self.byte(), self.byte()])) / 8192.0
    }

    pub fn is_over(&self) -> bool {
        self.0.is_empty()
    }
}
