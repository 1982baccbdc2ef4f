//! Colours that readers can tell apart in print and with colour blindness, on a light card.
//! This module draws nothing.

/// A colour with its opacity `alpha` in 0..=1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Colour {
    pub(super) rgb: [u8; 3],
    pub(super) alpha: f32,
}

impl Colour {
    /// The opaque colour 0xrrggbb.
    const fn new(hex: u32) -> Self {
        let [_, r, g, b] = hex.to_be_bytes();
        let rgb = [r, g, b];
        Self { rgb, alpha: 1.0 }
    }

    /// Returns the colour without its alpha, as #rrggbb.
    pub(super) fn hex(self) -> String {
        let [r, g, b] = self.rgb;
        format!("#{r:02x}{g:02x}{b:02x}")
    }

    pub(super) const fn with_alpha(self, alpha: f32) -> Self {
        Self { alpha, ..self }
    }
}

/// The card under a figure: light, so that a figure reads the same on a dark page and on paper.
pub(super) const CARD: Colour = Colour::new(0xffffff);
pub(super) const CARD_BORDER: Colour = Colour::new(0xd0d5dd);
/// Text and axes.
pub(super) const INK: Colour = Colour::new(0x1a1e24);
/// Notes and tick labels.
pub(super) const INK_SOFT: Colour = Colour::new(0x48505c);
pub(super) const GRID: Colour = Colour::new(0xe4e7ec);
/// The grey of reference lines, with which a chart compares its series.
pub const GREY: Colour = Colour::new(0x787e87);
/// Dark cells of a lattice. The next two are its light cells, and the frame that marks part of a map.
pub(super) const CELL_DARK: Colour = Colour::new(0x262a30);
pub(super) const CELL_LIGHT: Colour = Colour::new(0xf6f7f9);
pub(super) const OUTLINE: Colour = Colour::new(0xd55e00);
/// A heat map cell without a value.
const NO_VALUE: Colour = Colour::new(0xdcdee2);

pub(crate) const SERIES_COLOURS: usize = 7;
/// Colours of series. Source: Okabe and Ito 2008, without the yellow, which is faint on white.
const SERIES: [u32; SERIES_COLOURS] = [
    0x0072b2, 0xd55e00, 0x009e73, 0xcc79a7, 0xe69f00, 0x56b4e9, 0x000000,
];

/// Returns the colour of the series with this index. The colours repeat after seven series.
pub(crate) const fn series_colour(index: usize) -> Colour {
    Colour::new(SERIES[index % SERIES.len()])
}

/// Nine colours of viridis, evenly spaced. Source: matplotlib's viridis, by van der Walt and Smith, CC0.
const VIRIDIS: [u32; 9] = [
    0x440154, 0x472c7a, 0x3b518b, 0x2c718e, 0x21908d, 0x27ad81, 0x5cc863, 0xaadc32, 0xfde725,
];

/// Returns the viridis colour of `share` in 0..=1, dark to light; grey if not finite. Viridis is even to the eye, also if colour-blind.
pub(super) fn heat_colour(share: f64) -> Colour {
    if !share.is_finite() {
        return NO_VALUE;
    }
    let place = share.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f64;
    let low = (place as usize).min(VIRIDIS.len() - 2);
    let part = place - low as f64;
    let ends = [low, low + 1].map(|at| Colour::new(VIRIDIS[at]));
    let mix = |i: usize| {
        let [a, b] = ends.map(|end| f64::from(end.rgb[i]));
        (a + (b - a) * part).round() as u8
    };
    let rgb = [0, 1, 2].map(mix);
    Colour { rgb, ..ends[0] }
}

/// Returns dark or light ink, whichever is easier to read on `colour`.
pub(super) fn ink_on(colour: Colour) -> Colour {
    let [r, g, b] = colour.rgb.map(f64::from);
    let brightness = 0.299 * r + 0.587 * g + 0.114 * b;
    if brightness > 140.0 { INK } else { CARD }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_ends_where_it_should() {
        assert_eq!(heat_colour(0.0), Colour::new(VIRIDIS[0]));
        assert_eq!(heat_colour(1.0), Colour::new(VIRIDIS[8]));
        assert_eq!(heat_colour(7.0), heat_colour(1.0));
        assert_eq!(heat_colour(0.5), Colour::new(VIRIDIS[4]));
        assert_eq!(heat_colour(f64::NAN), NO_VALUE);
        assert_eq!(ink_on(heat_colour(0.0)), CARD);
        assert_eq!(ink_on(heat_colour(1.0)), INK);
    }
}
