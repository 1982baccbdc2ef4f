//! Colours that readers can tell apart in print and with colour blindness, on a light card.
//! This module draws nothing.

/// A colour with its opacity `alpha` in 0..=1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Colour {
    pub(super) rgb: [u8; 3],
    pub(super) alpha: f32,
}

impl Colour {
    const fn new(r: u8, g: u8, b: u8) -> Self {
        Self {
            rgb: [r, g, b],
            alpha: 1.0,
        }
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
pub(super) const CARD: Colour = Colour::new(255, 255, 255);
pub(super) const CARD_BORDER: Colour = Colour::new(208, 213, 221);
/// Text and axes.
pub(super) const INK: Colour = Colour::new(26, 30, 36);
/// Notes and tick labels.
pub(super) const INK_SOFT: Colour = Colour::new(72, 80, 92);
pub(super) const GRID: Colour = Colour::new(228, 231, 236);
/// The grey of reference lines, with which a chart compares its series.
pub const GREY: Colour = Colour::new(120, 126, 135);
/// Dark cells of a lattice. The next two are its light cells, and the frame that marks part of a map.
pub(super) const CELL_DARK: Colour = Colour::new(38, 42, 48);
pub(super) const CELL_LIGHT: Colour = Colour::new(246, 247, 249);
pub(super) const OUTLINE: Colour = Colour::new(213, 94, 0);
/// A heat map cell without a value.
const NO_VALUE: Colour = Colour::new(220, 222, 226);

pub(crate) const SERIES_COLOURS: usize = 7;
/// Colours of series. Source: Okabe and Ito 2008, without the yellow, which is faint on white.
const SERIES: [Colour; SERIES_COLOURS] = [
    Colour::new(0, 114, 178),
    Colour::new(213, 94, 0),
    Colour::new(0, 158, 115),
    Colour::new(204, 121, 167),
    Colour::new(230, 159, 0),
    Colour::new(86, 180, 233),
    Colour::new(0, 0, 0),
];

/// Returns the colour of the series with this index. The colours repeat after seven series.
pub(crate) const fn series_colour(index: usize) -> Colour {
    SERIES[index % SERIES.len()]
}

/// Nine colours of viridis, evenly spaced. Source: matplotlib's viridis, by van der Walt and Smith, CC0.
const VIRIDIS: [[u8; 3]; 9] = [
    [68, 1, 84],
    [71, 44, 122],
    [59, 81, 139],
    [44, 113, 142],
    [33, 144, 141],
    [39, 173, 129],
    [92, 200, 99],
    [170, 220, 50],
    [253, 231, 37],
];

/// Returns the viridis colour of `share` in 0..=1, dark to light; grey if not finite. Viridis is even to the eye, also if colour-blind.
pub(super) fn heat_colour(share: f64) -> Colour {
    if !share.is_finite() {
        return NO_VALUE;
    }
    let place = share.clamp(0.0, 1.0) * (VIRIDIS.len() - 1) as f64;
    let low = (place as usize).min(VIRIDIS.len() - 2);
    let part = place - low as f64;
    let mix = |i: usize| {
        let (a, b) = (f64::from(VIRIDIS[low][i]), f64::from(VIRIDIS[low + 1][i]));
        (a + (b - a) * part).round() as u8
    };
    Colour::new(mix(0), mix(1), mix(2))
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
        assert_eq!(heat_colour(0.0).rgb, VIRIDIS[0]);
        assert_eq!(heat_colour(1.0).rgb, VIRIDIS[8]);
        assert_eq!(heat_colour(7.0), heat_colour(1.0));
        assert_eq!(heat_colour(0.5).rgb, VIRIDIS[4]);
        assert_eq!(heat_colour(f64::NAN), NO_VALUE);
        assert_eq!(ink_on(heat_colour(0.0)), CARD);
        assert_eq!(ink_on(heat_colour(1.0)), INK);
    }
}
