//! The memory that an actor and a world's process share, read and written here as a file: what passes in each step, and a state.

use std::fs::File;
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::FileExt;

use nix::fcntl::{FcntlArg, SealFlag, fcntl};
use nix::sys::memfd::{MFdFlags, memfd_create};
use serde::Serialize;

use crate::environment::FrameShape;

/// Each column begins at a multiple of this, so that no two of them share a line of a processor's cache.
const ALIGNMENT: usize = 64;

/// Where each column begins, and how long the whole is; bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(super) struct Layout {
    bytes: usize,
    actions: usize,
    rewards: usize,
    ends: usize,
    frames: usize,
}

impl Layout {
    pub(super) const fn new(copies: usize, shape: FrameShape) -> Self {
        let rewards = copies.next_multiple_of(ALIGNMENT);
        let ends = (rewards + copies * size_of::<f32>()).next_multiple_of(ALIGNMENT);
        let frames = (ends + copies).next_multiple_of(ALIGNMENT);
        Self {
            bytes: frames + copies * shape.bytes(),
            actions: 0,
            rewards,
            ends,
            frames,
        }
    }
}

/// The memory. It has no name, and goes with the last of the two processes.
pub(super) struct Block {
    file: File,
    layout: Layout,
    copies: usize,
    /// Rewards, padding, ends: memory to use again.
    results: Vec<u8>,
}

impl Block {
    /// Makes the memory, whose size nobody can change afterwards.
    ///
    /// # Errors
    /// The operating system refuses.
    pub(super) fn new(copies: usize, shape: FrameShape) -> io::Result<Self> {
        let layout = Layout::new(copies, shape);
        let flags = MFdFlags::MFD_CLOEXEC | MFdFlags::MFD_ALLOW_SEALING;
        let file = File::from(memfd_create(c"driml-world", flags)?);
        file.set_len(layout.bytes as u64)?;
        let seals = SealFlag::F_SEAL_SHRINK | SealFlag::F_SEAL_GROW | SealFlag::F_SEAL_SEAL;
        fcntl(&file, FcntlArg::F_ADD_SEALS(seals))?;
        Ok(Self {
            file,
            layout,
            copies,
            results: vec![0; layout.ends + copies - layout.rewards],
        })
    }

    pub(super) const fn layout(&self) -> Layout {
        self.layout
    }

    pub(super) fn path(&self) -> String {
        path(&self.file)
    }

    /// Puts down the actions [N].
    ///
    /// # Errors
    /// The operating system refuses.
    pub(super) fn write_actions(&self, actions: &[u8]) -> io::Result<()> {
        self.file.write_all_at(actions, self.layout.actions as u64)
    }

    /// Reads rewards [N] and the numbers of ends [N].
    ///
    /// # Errors
    /// The operating system refuses.
    pub(super) fn read_results(&mut self, rewards: &mut [f32]) -> io::Result<&[u8]> {
        self.file
            .read_exact_at(&mut self.results, self.layout.rewards as u64)?;
        let (numbers, ends) = self
            .results
            .split_at(self.layout.ends - self.layout.rewards);
        for (reward, bytes) in rewards
            .iter_mut()
            .zip(numbers.chunks_exact(size_of::<f32>()))
        {
            *reward = f32::from_ne_bytes(bytes.try_into().expect("four bytes"));
        }
        Ok(&ends[..self.copies])
    }

    /// Reads the frames [N, H, W, C].
    ///
    /// # Errors
    /// The operating system refuses.
    pub(super) fn read_frames(&self, frames: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(frames, self.layout.frames as u64)
    }

    /// Puts down the frames [N, H, W, C], as after a step.
    ///
    /// # Errors
    /// The operating system refuses.
    pub(super) fn write_frames(&self, frames: &[u8]) -> io::Result<()> {
        self.file.write_all_at(frames, self.layout.frames as u64)
    }
}

/// Memory for a state of a world, whose length is that of the state. It goes when this is dropped.
pub(super) struct StateMemory {
    file: File,
}

impl StateMemory {
    /// # Errors
    /// The operating system refuses.
    pub(super) fn new(state: &[u8]) -> io::Result<Self> {
        let file = File::from(memfd_create(c"driml-world-state", MFdFlags::MFD_CLOEXEC)?);
        file.write_all_at(state, 0)?;
        Ok(Self { file })
    }

    pub(super) fn path(&self) -> String {
        path(&self.file)
    }

    /// How long the state is that lies there, bytes.
    ///
    /// # Errors
    /// The operating system refuses.
    pub(super) fn len(&self) -> io::Result<u64> {
        Ok(self.file.metadata()?.len())
    }

    /// Reads the first `len` bytes.
    ///
    /// # Errors
    /// The operating system refuses, or there are fewer.
    pub(super) fn read(&self, len: usize) -> io::Result<Vec<u8>> {
        let mut state = vec![0; len];
        self.file.read_exact_at(&mut state, 0)?;
        Ok(state)
    }
}

/// Under which name another process of the same user opens a file without one, as long as this process lives.
fn path(file: &File) -> String {
    format!("/proc/{}/fd/{}", std::process::id(), file.as_raw_fd())
}
