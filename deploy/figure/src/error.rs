//! What kept a figure, a picture or a film from its file.

use std::path::{Path, PathBuf};

/// What kept a figure from its file.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// The name asks for no kind of picture that there is.
    #[error("{} has no extension of a picture: take a name that ends in .svg, .pdf or .png", .0.display())]
    Extension(PathBuf),
    /// The name is not a film's.
    #[error("{} is not the name of a film: use one that ends in .gif", .0.display())]
    NoFilm(PathBuf),
    /// A picture or film of no area, or too large.
    #[error("a picture of {width} x {height} pixels cannot be made")]
    Size {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// A picture cannot be encoded.
    #[error("encoding a picture: {0}")]
    Encode(String),
    /// The file system refused.
    #[error("writing {}", .path.display())]
    Write {
        /// The file that was to be written.
        path: PathBuf,
        /// What the file system said.
        source: std::io::Error,
    },
}

impl FigureError {
    /// A file that cannot be written.
    pub(super) fn write(path: &Path, source: std::io::Error) -> Self {
        let path = path.to_owned();
        Self::Write { path, source }
    }
}
