//! Converts SVG to pixels or to PDF. Letters in the SVG are outlines, so no installed font is needed.
//! The look of a figure is decided where its SVG is written, not here.

use resvg::{
    tiny_skia::{Pixmap, Transform},
    usvg::{Options, Tree},
};
use svg2pdf::{ConversionOptions, PageOptions};

/// Why a figure or a picture could not be made.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct FigureError(pub(super) String);

impl FigureError {
    fn encoding(e: impl std::fmt::Display) -> Self {
        Self(format!("encoding a picture: {e}"))
    }
}

/// Renders the SVG as a PNG with `zoom` pixels for each unit. Pixels that no shape covers are transparent.
pub(super) fn png(svg: &str, zoom: f32) -> Result<Vec<u8>, FigureError> {
    let tree = parse_svg(svg)?;
    let sides = [tree.size().width(), tree.size().height()];
    let [width, height] = sides.map(|side| (side * zoom).ceil() as usize);
    let mut pixmap = new_pixmap(width, height)?;
    let scale = Transform::from_scale(zoom, zoom);
    resvg::render(&tree, scale, &mut pixmap.as_mut());
    encode_png(&pixmap)
}

/// Converts the SVG to a PDF of one page. A unit is a CSS pixel, 1/96 inch.
pub(super) fn pdf(svg: &str) -> Result<Vec<u8>, FigureError> {
    let page = PageOptions { dpi: 96.0 };
    let bytes = svg2pdf::to_pdf(&parse_svg(svg)?, ConversionOptions::default(), page);
    bytes.map_err(FigureError::encoding)
}

pub(super) fn parse_svg(svg: &str) -> Result<Tree, FigureError> {
    Tree::from_str(svg, &Options::default()).map_err(FigureError::encoding)
}

pub(super) fn new_pixmap(width: usize, height: usize) -> Result<Pixmap, FigureError> {
    let size = u32::try_from(width).ok().zip(u32::try_from(height).ok());
    let pixmap = size.and_then(|(width, height)| Pixmap::new(width, height));
    let why = || format!("a picture of {width} x {height} pixels cannot be made");
    pixmap.ok_or_else(|| FigureError(why()))
}

/// Encodes the pixels as a PNG file. tiny-skia's encoder compresses fast and gives a file three times as large.
pub(super) fn encode_png(pixmap: &Pixmap) -> Result<Vec<u8>, FigureError> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, pixmap.width(), pixmap.height());
    encoder.set_color(png::ColorType::Rgba);
    encoder.set_compression(png::Compression::Default);
    encoder.set_adaptive_filter(png::AdaptiveFilterType::Adaptive);
    let pixels = pixmap.pixels().iter().flat_map(|it| {
        let it = it.demultiply();
        [it.red(), it.green(), it.blue(), it.alpha()]
    });
    let pixels: Vec<u8> = pixels.collect();
    let header = encoder.write_header();
    let written = header.and_then(|mut image| image.write_image_data(&pixels));
    written.map_err(FigureError::encoding)?;
    Ok(file)
}
