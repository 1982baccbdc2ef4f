//! Stacks the newest few frames of each environment into one image with more channels.
//! It keeps no history beyond the stack, and it does not enlarge or convert pixels.

use crate::environment::FrameShape;
use crate::error::EnvError;
use crate::saved;

/// For each of N environments the newest `stack` frames, [N, H, W, C * stack].
///
/// A pixel's channels are those of the oldest frame first: [oldest C, ..., newest C]. At the first frame of an episode or
/// level every slot holds that frame, so a stack never reaches across an end.
pub struct FrameStack {
    shape: FrameShape,
    stack: usize,
    num_envs: usize,
    stacked: Vec<u8>,
}

impl FrameStack {
    /// An empty (all 0) stack of `stack` frames of `shape`, at least one, for `num_envs` environments; the first push of an environment
    /// must be `first`.
    pub fn new(shape: FrameShape, stack: usize, num_envs: usize) -> Self {
        Self {
            shape,
            stack,
            num_envs,
            stacked: vec![0; shape.bytes() * stack * num_envs],
        }
    }

    /// Adds the current `frames` [N, H, W, C]; `first` [N] says which are the first of an episode or level.
    ///
    /// # Panics
    /// If a slice has the wrong length: both come from the caller's own buffers.
    pub fn push(&mut self, frames: &[u8], first: &[bool]) {
        let bytes = self.shape.bytes();
        let expected = bytes * self.num_envs;
        assert_eq!(frames.len(), expected, "frames must be [N, H, W, C]");
        assert_eq!(first.len(), self.num_envs, "first must be [N]");
        if self.stack == 1 {
            self.stacked.copy_from_slice(frames);
            return;
        }
        let channels = self.shape.channels;
        let stacked_channels = channels * self.stack;
        let envs = self.stacked.chunks_exact_mut(bytes * self.stack);
        for ((stacked, frame), &first) in envs.zip(frames.chunks_exact(bytes)).zip(first) {
            let pixels = frame.chunks_exact(channels);
            if first {
                for (out, pixel) in stacked.chunks_exact_mut(stacked_channels).zip(pixels) {
                    out.chunks_exact_mut(channels)
                        .for_each(|slot| slot.copy_from_slice(pixel));
                }
            } else {
                // One move shifts every pixel; what spills into a pixel's last slot is overwritten right after.
                stacked.copy_within(channels.., 0);
                for (out, pixel) in stacked.chunks_exact_mut(stacked_channels).zip(pixels) {
                    out[stacked_channels - channels..].copy_from_slice(pixel);
                }
            }
        }
    }

    /// The stacked observations [N, H, W, C * stack].
    pub fn stacked(&self) -> &[u8] {
        &self.stacked
    }

    /// Restores the stacked observations [N, H, W, C * stack] of another stack of the same sizes.
    pub fn load(&mut self, stacked: &[u8]) -> Result<(), EnvError> {
        saved::ensure_fits(stacked.len() == self.stacked.len(), "a stack of frames")?;
        self.stacked.copy_from_slice(stacked);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The stack of environment `env` at time `t`, from the whole history: slot j is the frame `stack - 1 - j` back, but no
    /// further than the last first frame.
    fn reference(
        history: &[(Vec<u8>, Vec<bool>)],
        t: usize,
        env: usize,
        shape: FrameShape,
        stack: usize,
    ) -> Vec<u8> {
        let start = (0..=t).rev().find(|&i| history[i].1[env]).unwrap();
        let mut out = vec![];
        for pixel in 0..shape.height * shape.width {
            for back in (0..stack).rev() {
                let frame = &history[t.saturating_sub(back).max(start)].0;
                let at = env * shape.bytes() + pixel * shape.channels;
                out.extend_from_slice(&frame[at..at + shape.channels]);
            }
        }
        out
    }

    proptest! {
        #[test]
        fn equals_the_slow_reference(
            height in 1usize..4, width in 1usize..4, channels in 1usize..4, stack in 1usize..6, num_envs in 1usize..4,
            seed in any::<u64>(), steps in 1usize..20,
        ) {
            use rand::{Rng, SeedableRng};
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
            let shape = FrameShape::new(height, width, channels);
            let mut frames = FrameStack::new(shape, stack, num_envs);
            let mut history = vec![];
            for t in 0..steps {
                let frame: Vec<u8> = (0..shape.bytes() * num_envs).map(|_| rng.random()).collect();
                let first: Vec<bool> = (0..num_envs).map(|_| t == 0 || rng.random_bool(0.2)).collect();
                frames.push(&frame, &first);
                history.push((frame, first));
                let expected: Vec<u8> =
                    (0..num_envs).flat_map(|env| reference(&history, t, env, shape, stack)).collect();
                prop_assert_eq!(frames.stacked(), &expected[..]);
            }
        }
    }
}
