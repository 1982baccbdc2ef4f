//! A square of Ising spins hidden in a field of noise: predictable inside the patch, unpredictable outside it.
//! It has one action and no reward; it exists to show what DIM learns to predict.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::lattice::{Boundary, IsingLattice, check_temperature};
use crate::environment::{FrameShape, StepEnd};
use crate::envs::{RngUse, SerialWorld, SingleEnv, env_rng};
use crate::error::{EnvError, require};
use crate::saved;
use crate::settings::{BuildResult, WorldSettings};

/// The settings of the Ising world. The paper: lattice 84, patch 42, temperature 0.4.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IsingConfig {
    /// Side of the frame, in pixels = spins.
    pub lattice_size: usize,
    /// Side of the patch, in spins; at least 3, at most `lattice_size`.
    pub patch_size: usize,
    /// Temperature of the patch, in units of J / k_B, above 0 and at most 5; low means nearly deterministic.
    pub temperature: f64,
    /// Whether the patch's rim has neighbours on the far side (`periodic`) or none beyond it (`free`).
    pub boundary: Boundary,
    /// Metropolis sweeps over the patch in one env step, at least 1; more make the patch change faster.
    pub sweeps_per_step: u32,
    /// Env steps in an episode, at least 1; after them the patch moves and both fields are drawn afresh.
    pub episode_steps: u32,
}

/// N fields of spins drawn afresh at each step (0 is -1, 255 is +1, even odds), each with a patch that obeys the Ising
/// model. One action, no reward; an episode ends `TimedOut`.
///
/// The patch's place is uniform in each episode: for 42 in 84 its centre, row and column, is uniform on 21..=63.
/// Source: the paper's appendix on the Ising model, with the place fixed for an episode, as the main text says.
pub type IsingWorld = SerialWorld<SpinField>;

/// One field, and the lattice that is its patch.
pub struct SpinField {
    state: FieldState,
    patch: IsingLattice,
}

/// The state of a [`SpinField`] that does not follow from the settings, except the patch's spins.
#[derive(Clone, Serialize, Deserialize)]
pub struct FieldState {
    rng: ChaCha8Rng,
    /// Row and column of the patch's first site.
    origin: (usize, usize),
    frame: Vec<u8>,
    episode_step: u32,
}

impl IsingWorld {
    /// Row and column of the first site of environment `env`'s patch in the current episode; `None` if `env` is out of range.
    pub fn patch_origin(&self, env: usize) -> Option<(usize, usize)> {
        self.envs.get(env).map(|field| field.state.origin)
    }
}

impl WorldSettings for IsingConfig {
    fn validate(&self) -> Result<(), EnvError> {
        check_temperature(self.temperature)?;
        let (patch, lattice) = (self.patch_size, self.lattice_size);
        let why = format!(
            "the Ising world needs 3 <= patch_size <= lattice_size <= 1024, got patch_size = {patch} and lattice_size = {lattice}"
        );
        require((3..=lattice).contains(&patch) && lattice <= 1024, why)?;
        for (name, value) in [
            ("sweeps_per_step", self.sweeps_per_step),
            ("episode_steps", self.episode_steps),
        ] {
            let why = format!("the Ising world's {name} must be at least 1, got 0");
            require(value > 0, why)?;
        }
        Ok(())
    }

    /// `lattice_size` x `lattice_size` x 1.
    fn frame_shape(&self) -> FrameShape {
        FrameShape::new(self.lattice_size, self.lattice_size, 1)
    }

    fn action_names(&self) -> Vec<&str> {
        vec!["no-op"]
    }

    fn build(&self, num_envs: usize, seed: u64, _threads: usize) -> BuildResult {
        Ok(Box::new(IsingWorld::new(self, num_envs, seed)?))
    }
}

impl SingleEnv for SpinField {
    type Config = IsingConfig;

    /// The state and the patch's spins.
    type State = (FieldState, Vec<i8>);

    fn new(config: &IsingConfig, seed: u64, env: usize) -> Self {
        let mut rng = env_rng(seed, env, RngUse::Game);
        let (side, temperature, boundary) =
            (config.patch_size, config.temperature, config.boundary);
        let patch = IsingLattice::random(side, side, temperature, boundary, &mut rng);
        let state = FieldState {
            rng,
            origin: (0, 0),
            frame: vec![0; config.frame_shape().bytes()],
            episode_step: 0,
        };
        let mut field = Self { state, patch };
        field.reset(config);
        field
    }

    fn render(&self, _: &IsingConfig, frame: &mut [u8]) {
        frame.copy_from_slice(&self.state.frame);
    }

    fn act(&mut self, config: &IsingConfig, _: u8) -> (f32, StepEnd) {
        self.state.episode_step += 1;
        if self.state.episode_step >= config.episode_steps {
            self.reset(config);
            return (0.0, StepEnd::TimedOut);
        }
        for _ in 0..config.sweeps_per_step {
            self.patch.sweep(&mut self.state.rng);
        }
        self.paint(config);
        (0.0, StepEnd::Running)
    }

    fn state(&self) -> Self::State {
        (self.state.clone(), self.patch.spins().to_vec())
    }

    fn restore(&mut self, config: &IsingConfig, saved: Self::State) -> Result<(), EnvError> {
        let (state, spins) = saved;
        let (row, col) = state.origin;
        let origin_max = config.lattice_size - config.patch_size;
        saved::ensure_fits(row.max(col) <= origin_max, "the patch's place")?;
        saved::ensure_fits(state.frame.len() == config.frame_shape().bytes(), "a frame")?;
        self.patch.set_spins(&spins)?;
        self.state = state;
        Ok(())
    }
}

impl SpinField {
    fn reset(&mut self, config: &IsingConfig) {
        let origin_max = config.lattice_size - config.patch_size;
        self.state.origin = (
            self.state.rng.random_range(0..=origin_max),
            self.state.rng.random_range(0..=origin_max),
        );
        self.patch.randomise(&mut self.state.rng);
        self.state.episode_step = 0;
        self.paint(config);
    }

    /// Draws the noise afresh, and the patch over it.
    fn paint(&mut self, config: &IsingConfig) {
        for pixels in self.state.frame.chunks_mut(64) {
            let bits: u64 = self.state.rng.random();
            for (bit, pixel) in pixels.iter_mut().enumerate() {
                *pixel = (bits >> bit & 1) as u8 * 255;
            }
        }
        let ((top, left), side) = (self.state.origin, config.patch_size);
        for (row, spins) in self.patch.spins().chunks_exact(side).enumerate() {
            let start = (top + row) * config.lattice_size + left;
            let pixels = &mut self.state.frame[start..start + side];
            for (pixel, &spin) in pixels.iter_mut().zip(spins) {
                *pixel = if spin > 0 { 255 } else { 0 };
            }
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use rand::SeedableRng;

    use super::*;
    use crate::playing::{play, step};

    pub(crate) fn paper_config() -> IsingConfig {
        IsingConfig {
            lattice_size: 84,
            patch_size: 42,
            temperature: 0.4,
            boundary: Boundary::Free,
            sweeps_per_step: 1,
            episode_steps: 16,
        }
    }

    #[test]
    fn noise_is_fresh_and_the_patch_persists() {
        let mut world = IsingWorld::new(&paper_config(), 1, 7).unwrap();
        let (top, left) = world.patch_origin(0).unwrap();
        let seen = play(&mut world, 12, &mut ChaCha8Rng::seed_from_u64(0));
        assert!(seen.iter().all(|(_, rewards, _)| *rewards == [0.0]));
        let (mut noise, mut patch) = ((0, 0), (0, 0));
        for (i, (a, b)) in seen[10].0.iter().zip(&seen[11].0).enumerate() {
            let inside =
                (top..top + 42).contains(&(i / 84)) && (left..left + 42).contains(&(i % 84));
            let tally = if inside { &mut patch } else { &mut noise };
            *tally = (tally.0 + i32::from(a == b), tally.1 + 1);
        }
        assert_eq!(patch.1, 42 * 42);
        // Even odds over 5292 pixels: 5 standard deviations are 0.034. The coarsening patch keeps most of its spins.
        assert!((f64::from(noise.0) / f64::from(noise.1) - 0.5).abs() < 0.034);
        assert!(f64::from(patch.0) / f64::from(patch.1) > 0.8, "{patch:?}");
    }

    #[test]
    fn episodes_time_out_and_the_patch_moves_uniformly() {
        let config = IsingConfig {
            episode_steps: 1,
            patch_size: 3,
            lattice_size: 6,
            ..paper_config()
        };
        let mut world = IsingWorld::new(&config, 1, 8).unwrap();
        let mut counts = [0i32; 16];
        for _ in 0..16_000 {
            let (row, column) = world.patch_origin(0).unwrap();
            counts[row * 4 + column] += 1;
            let (_, ends) = step(&mut world, &[0]);
            assert_eq!(ends, [StepEnd::TimedOut]);
        }
        let squares = counts.map(|count| f64::from(count - 1000).powi(2));
        let chi = squares.iter().sum::<f64>() / 1000.0;
        // On 15 degrees of freedom, p = 0.001.
        assert!(chi < 37.7, "chi-square {chi}");
        let mut world = IsingWorld::new(&paper_config(), 1, 8).unwrap();
        let seen = play(&mut world, 32, &mut ChaCha8Rng::seed_from_u64(0));
        let times_out = |&t: &usize| seen[t].2 == [StepEnd::TimedOut];
        let timed_out: Vec<usize> = (0..32).filter(times_out).collect();
        assert_eq!(timed_out, [15, 31]);
    }
}
