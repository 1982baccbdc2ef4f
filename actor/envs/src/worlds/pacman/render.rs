//! How Ms. PacMan looks: one pixel a cell, [21, 19, 3] RGB.
//! It does not enlarge frames; what a frame cannot show (a ghost's mode, the boost's remaining steps) stays hidden.

use std::sync::LazyLock;

use super::maze::{GHOSTS, HEIGHT, Item, MAZE, Place, WIDTH};

/// Bytes per pixel.
pub(crate) const CHANNELS: usize = 3;
pub(crate) const FRAME_BYTES: usize = HEIGHT * WIDTH * CHANNELS;

pub(crate) type Colour = [u8; CHANNELS];

pub(crate) const WALL: Colour = [33, 33, 160];
pub(crate) const FLOOR: Colour = [0, 0, 0];
pub(crate) const PELLET: Colour = [120, 90, 60];
pub(crate) const BOOST: Colour = [255, 255, 255];
pub(crate) const AGENT: Colour = [255, 255, 0];
/// The agent while a boost lasts: paler, so that the frame tells whether it is invincible.
pub(crate) const AGENT_BOOSTED: Colour = [255, 255, 150];
/// Red, cyan, orange, green.
pub(crate) const GHOST_COLOURS: [Colour; GHOSTS] =
    [[255, 0, 0], [0, 255, 255], [255, 128, 0], [0, 255, 0]];
/// A wall whose Ising spin is +1; one with spin -1 is unchanged.
pub(crate) const FUCHSIA: Colour = [255, 0, 255];

/// A frame [21, 19, 3] of walls, floor and all the food.
pub(crate) static BACKGROUND: LazyLock<Vec<u8>> = LazyLock::new(background);

fn background() -> Vec<u8> {
    let mut frame = WALL.repeat(HEIGHT * WIDTH);
    for (place, item) in MAZE.places().zip(&MAZE.items) {
        let colour = match item {
            Item::Nothing => FLOOR,
            Item::Pellet => PELLET,
            Item::Boost => BOOST,
        };
        paint_pixel(&mut frame, MAZE.pixel(place), colour);
    }
    frame
}

/// Paints the walls by their spins [21 * 19]: fuchsia +1, wall -1; 0 (open cells) is left alone.
pub(crate) fn paint_spins(spins: &[i8], frame: &mut [u8]) {
    for (pixel, &spin) in frame.chunks_exact_mut(CHANNELS).zip(spins) {
        match spin {
            1 => pixel.copy_from_slice(&FUCHSIA),
            -1 => pixel.copy_from_slice(&WALL),
            _ => {}
        }
    }
}

/// Paints the ghosts, the first on top, and the agent over them.
pub(crate) fn paint_actors(ghosts: [Place; GHOSTS], agent: Place, boosted: bool, frame: &mut [u8]) {
    for (place, colour) in ghosts.into_iter().zip(GHOST_COLOURS).rev() {
        paint_pixel(frame, MAZE.pixel(place), colour);
    }
    let colour = if boosted { AGENT_BOOSTED } else { AGENT };
    paint_pixel(frame, MAZE.pixel(agent), colour);
}

pub(crate) fn paint_pixel(frame: &mut [u8], pixel: usize, colour: Colour) {
    frame[pixel * CHANNELS..][..CHANNELS].copy_from_slice(&colour);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_agent_is_over_the_ghosts_and_the_first_ghost_over_the_rest() {
        let mut frame = background();
        paint_actors([5, 5, 7, 7], 7, false, &mut frame);
        let at = |place| frame[MAZE.pixel(place) * CHANNELS..][..CHANNELS].to_vec();
        assert_eq!((at(5), at(7)), (GHOST_COLOURS[0].to_vec(), AGENT.to_vec()));
    }
}
