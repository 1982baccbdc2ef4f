//! An environment's complete state: how it is kept outside the engine, and how it is known again.
//! Getting one from the engine and putting one back is for `vec_game`.

use sha2::{Digest, Sha256};

use crate::error::ProcgenError;
use crate::game::Game;

/// Bytes of the sum before a sealed state.
const SUM_BYTES: usize = 32;

/// An environment's complete state, as the engine wrote it. The engine trusts what it reads back, so that only it makes one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct State {
    game: Game,
    bytes: Vec<u8>,
}

impl State {
    pub(crate) const fn written_by_engine(game: Game, bytes: Vec<u8>) -> Self {
        Self { game, bytes }
    }

    /// The game that it is a state of.
    pub const fn game(&self) -> Game {
        self.game
    }

    /// The engine's bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The state with a sum over it, for a file.
    pub fn sealed(&self) -> Vec<u8> {
        let name = self.game.name().as_bytes();
        let length = u8::try_from(name.len()).expect("a game's name is short");
        let mut content = vec![length];
        content.extend_from_slice(name);
        content.extend_from_slice(&self.bytes);
        let mut sealed = sum(&content);
        sealed.extend(content);
        sealed
    }

    /// Takes back what [`State::sealed`] gave. The sum keeps out what is damaged or something else. It does not keep out what was
    /// forged, which may end the process: take states from your own files alone.
    ///
    /// # Errors
    /// Bytes that are not a sealed state.
    pub fn unsealed(sealed: &[u8]) -> Result<Self, ProcgenError> {
        let damaged = || ProcgenError::State("a saved state that is damaged".to_owned());
        let (found, content) = sealed.split_at_checked(SUM_BYTES).ok_or_else(damaged)?;
        if found != sum(content) {
            return Err(damaged());
        }
        let (&length, rest) = content.split_first().ok_or_else(damaged)?;
        let (name, bytes) = rest
            .split_at_checked(usize::from(length))
            .ok_or_else(damaged)?;
        let name = std::str::from_utf8(name).map_err(|_| damaged())?;
        let game = name.parse().map_err(|_| damaged())?;
        Ok(Self {
            game,
            bytes: bytes.to_vec(),
        })
    }
}

fn sum(content: &[u8]) -> Vec<u8> {
    let mut sum = Sha256::new_with_prefix(b"driml: a state of Procgen's engine");
    sum.update(content);
    sum.finalize().to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sealed_state_comes_back_and_a_damaged_one_does_not() {
        let state = State::written_by_engine(Game::Maze, vec![1, 2, 3]);
        let sealed = state.sealed();
        assert_eq!(State::unsealed(&sealed).unwrap(), state);
        for at in 0..sealed.len() {
            let mut damaged = sealed.clone();
            damaged[at] ^= 1;
            assert!(State::unsealed(&damaged).is_err(), "byte {at}");
            assert!(State::unsealed(&sealed[..at]).is_err(), "{at} bytes");
        }
    }
}
