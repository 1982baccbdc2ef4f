//! Images and maps as convolutions take them: as they are stored, and as operands of products.

use crate::kernels::buffer::Buffer;
use crate::kernels::rounding::{store, store_bytes};
use crate::kernels::units::{Element, Unit};

/// Images [n, height, width, channels_in], as they are stored.
#[derive(Clone, Copy)]
pub(crate) enum Pixels<'a> {
    /// Scaled by 1/255 when read.
    Bytes(&'a [u8]),
    Floats(&'a [f32]),
}

impl<'a> Pixels<'a> {
    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Bytes(bytes) => bytes.len(),
            Self::Floats(floats) => floats.len(),
        }
    }

    /// The scalars `range` of all images.
    pub(crate) fn slice(&self, range: std::ops::Range<usize>) -> Self {
        match self {
            Self::Bytes(bytes) => Self::Bytes(&bytes[range]),
            Self::Floats(floats) => Self::Floats(&floats[range]),
        }
    }

    /// The images and `PADDING` as operands, and what products with them are multiplied by.
    pub(crate) fn operands<U: Unit>(&self, unit: U) -> (Buffer<U::Element>, f32) {
        let mut values = Buffer::new(self.len() + PADDING);
        values[self.len()..].fill(U::Element::default());
        let scale = match *self {
            Self::Bytes(bytes) => {
                store_bytes(unit, bytes, &mut values);
                U::Element::BYTE_SCALE
            }
            Self::Floats(floats) => {
                store(unit, floats, &mut values);
                1.0
            }
        };
        (values, scale)
    }
}

/// Scalars after the last image: where a run is odd, the last step of the last window reads one further, times 0.
pub(crate) const PADDING: usize = 1;

/// Images [n, height, width, channels_in] and `PADDING`, as operands of products.
#[derive(Clone, Copy)]
pub(crate) struct Images<'a, E> {
    pub(crate) values: &'a [E],
    /// What a product with them is multiplied by.
    pub(crate) scale: f32,
}

impl<'a, E> Images<'a, E> {
    /// The maps of another layer.
    pub(crate) const fn of_maps(values: &'a [E]) -> Self {
        Self { values, scale: 1.0 }
    }
}
