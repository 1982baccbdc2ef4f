//! Floats in saved state as the integers of their bits: what is loaded is what was saved, whatever reads the text.
//! It is for state only; settings stay readable numbers.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::DeserializeOwned};

/// A float with an integer of its size.
pub(super) trait Bits: Copy {
    /// The integer type of the float's size.
    type Word: Serialize + DeserializeOwned;
    fn word(self) -> Self::Word;
    fn of(word: Self::Word) -> Self;
}

impl Bits for f32 {
    type Word = u32;
    fn word(self) -> u32 {
        self.to_bits()
    }
    fn of(word: u32) -> Self {
        Self::from_bits(word)
    }
}

impl Bits for f64 {
    type Word = u64;
    fn word(self) -> u64 {
        self.to_bits()
    }
    fn of(word: u64) -> Self {
        Self::from_bits(word)
    }
}

pub(super) fn serialize<T: Bits, S: Serializer>(values: &[T], to: S) -> Result<S::Ok, S::Error> {
    to.collect_seq(values.iter().map(|&value| value.word()))
}

pub(super) fn deserialize<'de, T: Bits, D: Deserializer<'de>>(from: D) -> Result<Vec<T>, D::Error> {
    Ok(Vec::<T::Word>::deserialize(from)?
        .into_iter()
        .map(T::of)
        .collect())
}
