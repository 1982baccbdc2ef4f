//! States that are stacks of frames, as a batch carries them: each frame once, and of each state which frames it is.
//! Which frames are the same the replay server knows by where it holds them; no bytes are compared.

use serde::{Deserialize, Serialize};

use crate::run_spec::{FRAME_STACK_MAX, RunSpec};

/// The number of a frame in its batch, little-endian.
type Number = [u8; size_of::<u32>()];

/// How the states of a batch are made of the frames that travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StackedFrames {
    /// Frames that travel.
    pub frames: u32,
    /// Frames of one state, 2 to 16, oldest first along the channels.
    pub frame_stack: u32,
    /// Bytes a pixel of a frame.
    pub frame_channels: u32,
}

impl StackedFrames {
    /// Those of a batch of `rows` rows, no two of which share a frame; none where a state is one frame.
    pub(super) fn of(spec: &RunSpec, rows: u32) -> Option<Self> {
        (spec.frame_stack > 1).then(|| Self {
            frames: rows.saturating_mul(row_frames_max(spec)),
            frame_stack: spec.frame_stack,
            frame_channels: spec.frame_channels,
        })
    }

    /// Whether `states` states of so many bytes can be made of them.
    pub(super) fn fit(&self, states: usize, state_bytes: usize) -> bool {
        let stack = self.frame_stack as usize;
        let pixel_bytes = stack.checked_mul(self.frame_channels as usize);
        (2..=FRAME_STACK_MAX).contains(&self.frame_stack)
            && pixel_bytes.is_some_and(|bytes| bytes > 0 && state_bytes.is_multiple_of(bytes))
            && (self.frames as usize).div_ceil(stack) <= states
    }

    pub(super) const fn frame_bytes(&self, state_bytes: usize) -> usize {
        state_bytes / self.frame_stack as usize
    }

    /// Bytes that say of which frames a state is made.
    pub(super) const fn stack_bytes(&self) -> usize {
        self.frame_stack as usize * size_of::<Number>()
    }

    /// The first number in `stacks` that is not a frame's.
    pub(super) fn first_unknown(&self, stacks: &[u8]) -> Option<u32> {
        numbers(stacks).find(|number| *number >= self.frames)
    }

    /// Writes into `stack` of which frames a state is made, oldest first.
    pub(super) fn write(stack: &mut [u8], frames: &[u32]) {
        let (places, _) = stack.as_chunks_mut::<{ size_of::<Number>() }>();
        assert_eq!(places.len(), frames.len(), "a number for each of a stack");
        for (place, number) in places.iter_mut().zip(frames) {
            *place = number.to_le_bytes();
        }
    }

    /// Makes every number in `stacks` larger by `frames`.
    pub(super) fn shift(stacks: &mut [u8], frames: u32) {
        for place in stacks.as_chunks_mut().0 {
            *place = (u32::from_le_bytes(*place) + frames).to_le_bytes();
        }
    }

    /// The states [.., H, W, C * stack] of which `stacks` says the frames; `frames` are those that travel, [.., H, W, C].
    pub(super) fn stacked(&self, frames: &[u8], stacks: &[u8], state_bytes: usize) -> Vec<u8> {
        let (frame_bytes, stack) = (self.frame_bytes(state_bytes), self.frame_stack as usize);
        let stacks = stacks.chunks_exact(self.stack_bytes());
        let mut states = vec![0; stacks.len() * state_bytes];
        for (state, numbers_of) in states.chunks_exact_mut(state_bytes).zip(stacks) {
            let mut of_state: [&[u8]; FRAME_STACK_MAX as usize] = Default::default();
            for (frame, number) in of_state.iter_mut().zip(numbers(numbers_of)) {
                *frame = &frames[number as usize * frame_bytes..][..frame_bytes];
            }
            interleave(&of_state[..stack], self.frame_channels as usize, state);
        }
        states
    }
}

/// Most distinct frames of a row: those of s_t, and those that come after it up to the last state.
///
/// A later state adds no more frames than a stack has, nor more than steps lie between.
fn row_frames_max(spec: &RunSpec) -> u32 {
    let (stack, n, k_max) = (spec.frame_stack, spec.n_step, spec.horizon.k_max());
    let of_positives = k_max.min(stack.saturating_mul(spec.horizon.positives() as u32));
    stack + n.max(k_max).min(stack.min(n) + of_positives)
}

fn numbers(stacks: &[u8]) -> impl Iterator<Item = u32> {
    let (places, _) = stacks.as_chunks();
    places.iter().copied().map(u32::from_le_bytes)
}

/// Writes `frames`, each [pixels, C], into `out` [pixels, stack, C].
///
/// A pixel of the output is written at once: the sizes in use are compiled, the others take their time.
fn interleave(frames: &[&[u8]], pixel_bytes: usize, out: &mut [u8]) {
    fn compiled<const STACK: usize, const C: usize>(frames: &[&[u8]], out: &mut [u8]) {
        let frames: [&[[u8; C]]; STACK] = std::array::from_fn(|slot| frames[slot].as_chunks().0);
        let (pixels, _) = out.as_chunks_mut::<C>().0.as_chunks_mut::<STACK>();
        // Equal lengths, known before the loop, keep bounds checks out of it.
        let frames = frames.map(|frame| &frame[..pixels.len()]);
        for (i, pixel) in pixels.iter_mut().enumerate() {
            for slot in 0..STACK {
                pixel[slot] = frames[slot][i];
            }
        }
    }
    match (frames.len(), pixel_bytes) {
        (4, 1) => compiled::<4, 1>(frames, out),
        (4, 3) => compiled::<4, 3>(frames, out),
        (stack, _) => {
            for (slot, frame) in frames.iter().enumerate() {
                let to = out.chunks_exact_mut(pixel_bytes).skip(slot).step_by(stack);
                to.zip(frame.chunks_exact(pixel_bytes))
                    .for_each(|(to, from)| to.copy_from_slice(from));
            }
        }
    }
}
