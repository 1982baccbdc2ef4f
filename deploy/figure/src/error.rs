//! The errors of making and writing figures, pictures and films.

use std::path::{Path, PathBuf};

/// Why a figure, a picture or a film could not be made or written.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// The extension of the name is not that of a supported format.
    #[error("{} is not the name of a picture: use one that ends in .svg, .pdf or .png", .0.display())]
    Extension(PathBuf),
    /// The name of a film does not end in `.gif`.
    #[error("{} is not the name of a film: use one that ends in .gif", .0.display())]
    FilmExtension(PathBuf),
    /// The picture or film has no area or is too large.
    #[error("a picture of {width} x {height} pixels cannot be made")]
    Size {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// The picture cannot be encoded.
    #[error("encoding a picture: {0}")]
    Encode(String),
    /// The file cannot be written.
    #[error("writing {}", .path.display())]
    Write {
        /// The path of the file.
        path: PathBuf,
        /// The error of the file system.
        source: std::io::Error,
    },
}

impl FigureError {
    pub(super) fn write(path: &Path, source: std::io::Error) -> Self {
        let path = path.to_owned();
        Self::Write { path, source }
    }
}
