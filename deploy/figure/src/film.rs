//! A sequence of pictures as an animated GIF that repeats forever. Pixels that did not change are stored as transparent.
//! Only the last picture is kept in memory.

use std::io::{self, Write};

use gif::{Encoder, Frame, Repeat};

use crate::picture::Picture;

/// The shortest delay that viewers respect, in hundredths of a second. Some viewers ignore a shorter delay.
const DELAY_MIN: u16 = 2;

/// A film (animated GIF) that is being written.
pub struct Film<W: Write> {
    encoder: Encoder<W>,
    size: (u16, u16),
    /// The delay of each picture in hundredths of a second. `owed` carries the rounding error, because GIF delays are whole numbers.
    delay: f64,
    owed: f64,
    previous: Option<Vec<[u8; 3]>>,
}

impl<W: Write> Film<W> {
    /// Begins a film of pictures of `size` (width, height), shown at `pictures_per_second`. `to` receives the bytes of the file.
    ///
    /// # Panics
    /// A side is above 65,535 pixels, the most that a GIF can have.
    pub fn begin(to: W, size: (usize, usize), pictures_per_second: f64) -> io::Result<Self> {
        let side = |length: usize| {
            u16::try_from(length).expect("a film has sides of at most 65,535 pixels")
        };
        let size = (side(size.0), side(size.1));
        let encoder = Encoder::new(to, size.0, size.1, &[]);
        let mut encoder = encoder.map_err(io::Error::other)?;
        let repeated = encoder.set_repeat(Repeat::Infinite);
        repeated.map_err(io::Error::other)?;
        Ok(Self {
            encoder,
            size,
            delay: (100.0 / pictures_per_second).max(DELAY_MIN.into()),
            owed: 0.0,
            previous: None,
        })
    }

    /// Adds a picture, shown for `times` the film's usual delay.
    ///
    /// # Panics
    /// The size of the picture differs from that of the film.
    pub fn add(&mut self, picture: &Picture, times: f64) -> io::Result<()> {
        let (width, height) = self.size;
        let size = (usize::from(width), usize::from(height));
        assert_eq!(picture.size(), size, "a film has pictures of one size");
        let pixels = picture.rgb();
        let changed = |(at, &[r, g, b]): (usize, &[u8; 3])| match &self.previous {
            Some(previous) if previous[at] == [r, g, b] => [0; 4],
            _ => [r, g, b, u8::MAX],
        };
        let mut rgba: Vec<u8> = pixels.iter().enumerate().flat_map(changed).collect();
        let mut frame = Frame::from_rgba(width, height, &mut rgba);
        self.owed += self.delay * times;
        let delay = self.owed.round().clamp(DELAY_MIN.into(), u16::MAX.into());
        self.owed -= delay;
        frame.delay = delay as u16;
        self.previous = Some(pixels);
        self.encoder.write_frame(&frame).map_err(io::Error::other)
    }

    /// Completes the film, and returns the file.
    pub fn finish(self) -> io::Result<W> {
        let mut file = self.encoder.into_inner().map_err(io::Error::other)?;
        file.flush()?;
        Ok(file)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(pixels: &[u8], width: usize) -> Picture {
        let height = pixels.len() / 3 / width;
        let mut picture = Picture::new(width, height).unwrap();
        picture.image((0, 0), 1, pixels, [height, width, 3]);
        picture
    }

    /// Makes a film of these pictures; returns the delays, and the whole pictures as a viewer composes them.
    fn played(pictures: &[Picture], rate: f64) -> (Vec<u16>, Vec<Vec<[u8; 3]>>) {
        let mut film = Film::begin(Vec::new(), pictures[0].size(), rate).unwrap();
        for picture in pictures {
            film.add(picture, 1.0).unwrap();
        }
        let bytes = film.finish().unwrap();
        let mut decoder = gif::Decoder::new(&*bytes).unwrap();
        let mut shown = vec![[9; 3]; pictures[0].rgb().len()];
        let (mut delays, mut seen) = (Vec::new(), Vec::new());
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            let palette = frame.palette.as_ref().unwrap();
            assert_eq!(frame.buffer.len(), shown.len(), "frames are whole pictures");
            for (pixel, &index) in shown.iter_mut().zip(frame.buffer.iter()) {
                if Some(index) != frame.transparent {
                    pixel.copy_from_slice(&palette[3 * usize::from(index)..][..3]);
                }
            }
            delays.push(frame.delay);
            seen.push(shown.clone());
        }
        (delays, seen)
    }

    #[test]
    fn a_viewer_sees_the_pictures_at_their_rate() {
        let mut pixels: Vec<u8> = (0..3 * 200).map(|i| (i * 7 % 251) as u8).collect();
        // From picture to picture either one pixel changes or none.
        let pictures = [1, 2, 2, 3, 4, 4].map(|value| {
            pixels[3 * 47] = value;
            picture(&pixels, 20)
        });
        let (delays, seen) = played(&pictures, 15.0);
        assert_eq!(delays, [7, 6, 7, 7, 6, 7], "15 a second");
        assert!(seen == pictures.map(|picture| picture.rgb()));
    }

    #[test]
    fn more_colours_than_a_gif_has_are_brought_near() {
        let pixel = |i: i32| [(i % 64) * 4, (i / 64) * 4, 128].map(|c| c as u8);
        let pixels: Vec<u8> = (0..64 * 64).flat_map(pixel).collect();
        // In the second picture only the lower half changes.
        let mut later = pixels.clone();
        later[3 * 32 * 64..].reverse();
        let pictures = [pixels, later].map(|pixels| picture(&pixels, 64));
        let (_, seen) = played(&pictures, 10.0);
        for (seen, wanted) in seen.iter().zip(pictures.map(|picture| picture.rgb())) {
            let off = seen.iter().flatten().zip(wanted.iter().flatten());
            let off: Vec<_> = off.map(|(&a, &b)| u32::from(a.abs_diff(b))).collect();
            let mean = f64::from(off.iter().sum::<u32>()) / off.len() as f64;
            let far = off.iter().filter(|&&off| off > 40).count();
            assert!(mean < 5.0 && far < off.len() / 100, "{mean} {far}");
        }
    }
}
