//! Stacked states as a batch contains them: each frame once, and for each state the numbers of its frames.
//! The replay server knows equal frames by their place in its memory; no bytes are compared.

use serde::{Deserialize, Serialize};

use crate::run_spec::{FRAME_STACK_MAX, RunSpec};

/// The number of a frame in its batch, little-endian.
type FrameNumber = [u8; size_of::<u32>()];

/// How the states of a batch are stacks of the frames in the payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StackedFrames {
    /// Frames in the payload.
    pub frames: u32,
    /// Frames in one state, 2 to 16, oldest first along the channels.
    pub frame_stack: u32,
    /// Bytes per pixel of a frame.
    pub frame_channels: u32,
}

impl StackedFrames {
    /// The stacks of a batch of `rows` rows, if no two rows share a frame; `None` if a state is one frame.
    pub(super) fn largest(spec: &RunSpec, rows: u32) -> Option<Self> {
        (spec.frame_stack > 1).then(|| Self {
            frames: rows.saturating_mul(row_frames_max(spec)),
            frame_stack: spec.frame_stack,
            frame_channels: spec.frame_channels,
        })
    }

    /// Whether the frames can form `states` states of `state_bytes` bytes.
    pub(super) fn can_form(&self, states: usize, state_bytes: usize) -> bool {
        let stack = self.frame_stack as usize;
        let pixel_bytes = stack.checked_mul(self.frame_channels as usize);
        (2..=FRAME_STACK_MAX).contains(&self.frame_stack)
            && pixel_bytes
                .is_some_and(|it| (1..=state_bytes).contains(&it) && state_bytes.is_multiple_of(it))
            && (self.frames as usize).div_ceil(stack) <= states
    }

    pub(super) const fn frame_bytes(&self, state_bytes: usize) -> usize {
        state_bytes / self.frame_stack as usize
    }

    /// Bytes of the frame numbers of one state.
    pub(super) const fn stack_bytes(&self) -> usize {
        self.frame_stack as usize * size_of::<FrameNumber>()
    }

    /// The first number in `stacks` that belongs to no frame.
    pub(super) fn first_unknown(&self, stacks: &[u8]) -> Option<u32> {
        frame_numbers(stacks).find(|number| *number >= self.frames)
    }

    pub(super) fn write_numbers(stacks: &mut [u8], frames: &[u32]) {
        let (places, _) = stacks.as_chunks_mut::<{ size_of::<FrameNumber>() }>();
        assert_eq!(places.len(), frames.len(), "a number for each place");
        for (place, number) in places.iter_mut().zip(frames) {
            *place = number.to_le_bytes();
        }
    }

    pub(super) fn shift_numbers(stacks: &mut [u8], frames: u32) {
        for place in stacks.as_chunks_mut().0 {
            *place = (u32::from_le_bytes(*place) + frames).to_le_bytes();
        }
    }

    /// Assembles the states [.., H, W, C * stack] whose frame numbers are `stacks`, from `frames` [.., H, W, C].
    pub(super) fn assemble(&self, frames: &[u8], stacks: &[u8], state_bytes: usize) -> Vec<u8> {
        let (frame_bytes, stack) = (self.frame_bytes(state_bytes), self.frame_stack as usize);
        let stacks = stacks.chunks_exact(self.stack_bytes());
        let mut states = vec![0; stacks.len() * state_bytes];
        for (state, stack_numbers) in states.chunks_exact_mut(state_bytes).zip(stacks) {
            let mut state_frames: [&[u8]; FRAME_STACK_MAX as usize] = Default::default();
            for (frame, number) in state_frames.iter_mut().zip(frame_numbers(stack_numbers)) {
                *frame = &frames[number as usize * frame_bytes..][..frame_bytes];
            }
            interleave(&state_frames[..stack], self.frame_channels as usize, state);
        }
        states
    }
}

/// Returns the most distinct frames that a row may have: those of s_t, and those after it up to the last state.
///
/// A later state adds at most as many frames as a stack has, and at most as many as there are steps between.
fn row_frames_max(spec: &RunSpec) -> u32 {
    let (stack, n, k_max) = (spec.frame_stack, spec.n_step, spec.horizon.k_max());
    let positive_frames = k_max.min(stack.saturating_mul(spec.horizon.positives() as u32));
    stack + n.max(k_max).min(stack.min(n) + positive_frames)
}

fn frame_numbers(stacks: &[u8]) -> impl Iterator<Item = u32> {
    let (places, _) = stacks.as_chunks();
    places.iter().copied().map(u32::from_le_bytes)
}

/// Writes `frames`, each [pixels, C], into `out` [pixels, stack, C].
///
/// Writes whole pixels of the output. The sizes in use have compiled loops; other sizes are slower.
fn interleave(frames: &[&[u8]], pixel_bytes: usize, out: &mut [u8]) {
    fn interleave_fixed<const STACK: usize, const C: usize>(frames: &[&[u8]], out: &mut [u8]) {
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
        (4, 1) => interleave_fixed::<4, 1>(frames, out),
        (4, 3) => interleave_fixed::<4, 3>(frames, out),
        (stack, _) => {
            for (slot, frame) in frames.iter().enumerate() {
                let to = out.chunks_exact_mut(pixel_bytes).skip(slot).step_by(stack);
                to.zip(frame.chunks_exact(pixel_bytes))
                    .for_each(|(to, from)| to.copy_from_slice(from));
            }
        }
    }
}
