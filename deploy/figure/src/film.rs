//! Pictures in turn, as an animated GIF that plays over and over. Only what changed from one picture to the next is stored.
//! It keeps no picture but the last, and knows nothing of what they show.

use std::{
    collections::HashMap,
    fs::File,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

use color_quant::NeuQuant;
use gif::{Encoder, Frame, Repeat};

use crate::{figure::FigureError, picture::Picture};

/// Colours that one picture may bring; one more index of the 256 stands for what did not change.
const COLOURS_MAX: usize = 255;
/// Hundredths of a second that viewers show a picture at least; some take less for none.
const DELAY_MIN: u16 = 2;

/// A film that is being written.
///
/// It lies beside its place under another name until it is whole, so that one that is given up leaves the older one there.
pub struct Film {
    path: PathBuf,
    aside: PathBuf,
    encoder: Encoder<BufWriter<File>>,
    size: (usize, usize),
    /// Hundredths of a second of each picture, and what is owed as delays are whole numbers.
    delay: f64,
    owed: f64,
    shown: Option<Vec<[u8; 3]>>,
}

impl Film {
    /// Whether a film can have this name.
    ///
    /// # Errors
    /// It does not end in `.gif`.
    pub fn check_name(path: &Path) -> Result<(), FigureError> {
        match path.extension() {
            Some(extension) if extension == "gif" => Ok(()),
            _ => Err(FigureError::NoFilm(path.to_owned())),
        }
    }

    /// Begins a film of pictures of `size`, (width, height), so many of them a second.
    ///
    /// # Errors
    /// A name that does not end in `.gif`, a size that no GIF has, a file that cannot be written.
    pub fn create(
        path: &Path,
        size: (usize, usize),
        pictures_per_second: f64,
    ) -> Result<Self, FigureError> {
        Self::check_name(path)?;
        let side = |length: usize| u16::try_from(length).ok().filter(|&it| it > 0);
        let (Some(width), Some(height)) = (side(size.0), side(size.1)) else {
            let (width, height) = size;
            return Err(FigureError::Size { width, height });
        };
        let mut aside = path.as_os_str().to_owned();
        aside.push(".tmp");
        let aside = PathBuf::from(aside);
        let failed = |source| FigureError::Write {
            path: path.to_owned(),
            source,
        };
        let file = File::create(&aside).map_err(failed)?;
        let begun = Encoder::new(BufWriter::new(file), width, height, &[]);
        let mut encoder = begun.map_err(|e| failed(std::io::Error::other(e)))?;
        let repeated = encoder.set_repeat(Repeat::Infinite);
        repeated.map_err(|e| failed(std::io::Error::other(e)))?;
        Ok(Self {
            path: path.to_owned(),
            aside,
            encoder,
            size,
            delay: (100.0 / pictures_per_second).max(DELAY_MIN.into()),
            owed: 0.0,
            shown: None,
        })
    }

    /// Adds a picture, which is shown `times` as long as the film's pictures are.
    ///
    /// # Errors
    /// A file that cannot be written.
    ///
    /// # Panics
    /// If the picture is of another size than the film.
    pub fn add(&mut self, picture: &Picture, times: f64) -> Result<(), FigureError> {
        assert_eq!(picture.size(), self.size, "a film has pictures of one size");
        let pixels = picture.rgb();
        let mut frame = changed(self.shown.as_deref(), &pixels, self.size);
        self.owed += self.delay * times;
        let delay = self.owed.round().clamp(DELAY_MIN.into(), u16::MAX.into());
        self.owed -= delay;
        frame.delay = delay as u16;
        let written = self.encoder.write_frame(&frame);
        self.shown = Some(pixels);
        written.map_err(|e| self.failed(std::io::Error::other(e)))
    }

    /// Ends the film and gives it its name.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn finish(self) -> Result<(), FigureError> {
        let Self {
            path,
            aside,
            encoder,
            ..
        } = self;
        let ended = encoder.into_inner().map_err(std::io::Error::other);
        let ended = ended.and_then(|mut file| file.flush());
        let ended = ended.and_then(|()| std::fs::rename(&aside, &path));
        ended.map_err(|source| FigureError::Write { path, source })
    }

    /// Gives the film up: what was written of it is removed.
    pub fn discard(self) {
        drop(self.encoder);
        // It is in nobody's way but a full disk's.
        let _ = std::fs::remove_file(&self.aside);
    }

    fn failed(&self, source: std::io::Error) -> FigureError {
        let path = self.path.clone();
        FigureError::Write { path, source }
    }
}

/// The smallest rectangle of `pixels` outside of which nothing differs from `shown`, with that index for what did not change within.
fn changed(
    shown: Option<&[[u8; 3]]>,
    pixels: &[[u8; 3]],
    (width, height): (usize, usize),
) -> Frame<'static> {
    let differs = |at: usize| shown.is_none_or(|shown| shown[at] != pixels[at]);
    let rows = |row: &usize| (0..width).any(|column| differs(row * width + column));
    let columns = |column: &usize| (0..height).any(|row| differs(row * width + column));
    // Of two equal pictures the first pixel is stored again: a frame has an area.
    let first_row = (0..height).find(rows).unwrap_or(0);
    let last_row = (0..height).rfind(rows).unwrap_or(0);
    let first_column = (0..width).find(columns).unwrap_or(0);
    let last_column = (0..width).rfind(columns).unwrap_or(0);
    let inside = (first_row..=last_row)
        .flat_map(|row| (first_column..=last_column).map(move |column| row * width + column));
    let inside: Vec<_> = inside.map(|at| differs(at).then_some(pixels[at])).collect();
    let Indexed { palette, indices } = Indexed::of(&inside);
    let side = |length: usize| u16::try_from(length).expect("a film's sides fit");
    let transparent = u8::try_from(palette.len() / 3).expect("at most 255 colours were kept");
    let mut frame = Frame::from_palette_pixels(
        side(last_column - first_column + 1),
        side(last_row - first_row + 1),
        indices,
        // The transparent index has a place in the palette, of any colour.
        [palette, vec![0; 3]].concat(),
        Some(transparent),
    );
    (frame.left, frame.top) = (side(first_column), side(first_row));
    frame
}

/// Pixels as places in a palette of at most [`COLOURS_MAX`] colours; the place behind the last is that of no pixel.
struct Indexed {
    palette: Vec<u8>,
    indices: Vec<u8>,
}

impl Indexed {
    fn of(pixels: &[Option<[u8; 3]>]) -> Self {
        let mut places = HashMap::new();
        let mut colours = Vec::new();
        for &colour in pixels.iter().flatten() {
            places.entry(colour).or_insert_with(|| {
                colours.push(colour);
                colours.len() - 1
            });
        }
        let mut palette = colours.concat();
        if colours.len() > COLOURS_MAX {
            // Each colour once: an enemy of three pixels keeps its own beside a large sky.
            let each: Vec<_> = colours
                .iter()
                .flat_map(|&[r, g, b]| [r, g, b, u8::MAX])
                .collect();
            let fewer = NeuQuant::new(1, COLOURS_MAX, &each);
            for (colour, place) in &mut places {
                let [r, g, b] = *colour;
                *place = fewer.index_of(&[r, g, b, u8::MAX]);
            }
            palette = fewer.color_map_rgb();
        }
        let none = palette.len() / 3;
        let indices = pixels.iter().map(|pixel| {
            let place = pixel.map_or(none, |colour| places[&colour]);
            u8::try_from(place).expect("256 places")
        });
        Self {
            indices: indices.collect(),
            palette,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::Image;

    fn picture(pixels: &[u8], width: usize) -> Picture {
        let mut picture = Picture::new(width, pixels.len() / 3 / width).unwrap();
        let image = Image {
            pixels,
            height: pixels.len() / 3 / width,
            width,
            channels: 3,
        };
        picture.image((0, 0), 1, image);
        picture
    }

    /// Delays, and whole pictures as a viewer builds them.
    fn play(path: &Path) -> (Vec<u16>, Vec<Vec<[u8; 3]>>) {
        let mut decoder = gif::Decoder::new(File::open(path).unwrap()).unwrap();
        let width = usize::from(decoder.width());
        let mut shown = vec![[9; 3]; width * usize::from(decoder.height())];
        let (mut delays, mut pictures) = (Vec::new(), Vec::new());
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            let palette = frame.palette.as_ref().unwrap();
            for (at, &index) in frame.buffer.iter().enumerate() {
                let (row, column) = (at / usize::from(frame.width), at % usize::from(frame.width));
                if Some(index) != frame.transparent {
                    let place =
                        (usize::from(frame.top) + row) * width + usize::from(frame.left) + column;
                    let colour = &palette[3 * usize::from(index)..][..3];
                    shown[place].copy_from_slice(colour);
                }
            }
            delays.push(frame.delay);
            pictures.push(shown.clone());
        }
        (delays, pictures)
    }

    #[test]
    fn a_viewer_sees_the_pictures_at_their_rate() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.gif");
        let mut pixels: Vec<u8> = (0..3 * 200).map(|i| (i * 7 % 251) as u8).collect();
        let mut film = Film::create(&path, (20, 10), 15.0).unwrap();
        let mut wanted = Vec::new();
        for step in 0..6 {
            // One pixel, then none, changes.
            pixels[3 * 47] = [1, 2, 2, 3, 4, 4][step];
            let picture = picture(&pixels, 20);
            wanted.push(picture.rgb());
            film.add(&picture, 1.0).unwrap();
        }
        film.finish().unwrap();
        let (delays, pictures) = play(&path);
        assert_eq!(delays, [7, 6, 7, 7, 6, 7], "15 a second");
        assert!(pictures == wanted);
        let files: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
        assert_eq!(files.len(), 1, "nothing else is left");
    }

    #[test]
    fn more_colours_than_a_gif_has_are_brought_near() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.gif");
        let pixels: Vec<u8> = (0..64 * 64)
            .flat_map(|i| [(i % 64) * 4, (i / 64) * 4, 128].map(|c| c as u8))
            .collect();
        let mut film = Film::create(&path, (64, 64), 10.0).unwrap();
        let first = picture(&pixels, 64);
        film.add(&first, 1.0).unwrap();
        film.finish().unwrap();
        let (_, pictures) = play(&path);
        let wanted = first.rgb();
        let off = pictures[0].iter().flatten().zip(wanted.iter().flatten());
        let off = off.map(|(&a, &b)| u32::from(a.abs_diff(b)));
        let mean = f64::from(off.clone().sum::<u32>()) / (3.0 * 64.0 * 64.0);
        assert!(mean < 5.0 && off.max().unwrap() < 40, "{mean}");
    }

    #[test]
    fn names_and_places_that_no_film_can_have() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["x", "x.png", "gif"] {
            let said = Film::create(&folder.path().join(name), (4, 4), 10.0)
                .err()
                .unwrap();
            assert!(said.to_string().contains("ends in .gif"), "{said}");
        }
        let nowhere = folder.path().join("none/x.gif");
        assert!(matches!(
            Film::create(&nowhere, (4, 4), 10.0),
            Err(FigureError::Write { .. })
        ));
        let path = folder.path().join("x.gif");
        assert!(Film::create(&path, (70_000, 4), 10.0).is_err());
        std::fs::write(&path, "older").unwrap();
        Film::create(&path, (4, 4), 10.0).unwrap().discard();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "older");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
