//! Encodes the state of a world as bytes, and checks the bytes when they are read back.
//! Each world decides what its state holds. The caller stores the bytes and makes sure that they are undamaged.

use serde::{Serialize, de::DeserializeOwned};

use crate::error::EnvError;

/// Longest state of a world, bytes.
const STATE_BYTES_MAX: usize = 1 << 28;

/// Encodes a world's state. Returns [`EnvError::NotSaved`] if the bytes are more than [`decode`] reads.
pub(crate) fn encode<T: Serialize>(state: &T) -> Result<Vec<u8>, EnvError> {
    let bytes = bincode::serde::encode_to_vec(state, bincode::config::standard())
        .map_err(|e| EnvError::State(e.to_string()))?;
    match bytes.len() {
        0..=STATE_BYTES_MAX => Ok(bytes),
        long => Err(EnvError::NotSaved(format!(
            "this world's state takes {long} bytes, and {STATE_BYTES_MAX} can be saved; use fewer environments (actor.envs)"
        ))),
    }
}

/// Decodes a state that [`encode`] wrote.
pub(crate) fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, EnvError> {
    let config = bincode::config::standard().with_limit::<STATE_BYTES_MAX>();
    let (state, used) = bincode::serde::decode_from_slice(bytes, config)
        .map_err(|e| EnvError::State(e.to_string()))?;
    match bytes.len() - used {
        0 => Ok(state),
        excess => Err(EnvError::State(format!("{excess} bytes after its end"))),
    }
}

/// Returns an error unless a state has as many environments as this world.
pub(crate) fn check_env_count(found: usize, num_envs: usize) -> Result<(), EnvError> {
    if found == num_envs {
        return Ok(());
    }
    Err(EnvError::State(format!(
        "{found} environments, and this world has {num_envs}"
    )))
}

/// Returns an error unless `holds`; `what` names the part of the state that does not fit the settings.
pub(crate) fn ensure_fits(holds: bool, what: &str) -> Result<(), EnvError> {
    let wrong = || EnvError::State(format!("{what} does not fit these settings"));
    holds.then_some(()).ok_or_else(wrong)
}

#[cfg(test)]
pub(crate) mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::{STATE_BYTES_MAX, encode};
    use crate::playing::{fails, play};
    use crate::worlds::{chain, ising};
    use crate::{Environment, IsingConfig, RestrictedWorld, StepEnd, WorldConfig};

    /// Environments of each world here.
    const ENVS: usize = 3;

    /// Checks that a second world from `make`, stepped before, continues as the first after it loads the first's state.
    /// Returns the number of ends since the state was saved.
    pub(crate) fn check_restore(
        name: &str,
        steps: usize,
        mut make: impl FnMut() -> Box<dyn Environment>,
    ) -> usize {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut world = make();
        play(&mut *world, steps, &mut rng);
        let state = world.save().unwrap();
        let at = rng.clone();
        let seen = play(&mut *world, steps, &mut rng);
        let ends = seen.iter().flat_map(|(.., ends)| ends);
        let ended = ends.filter(|&&end| end != StepEnd::Running).count();
        assert_ne!(world.save().unwrap(), state, "{name}");
        let mut other = make();
        // The state is complete: earlier steps of the second world do not matter.
        play(&mut *other, 5, &mut rng);
        other.load(&state).unwrap();
        assert_eq!(other.save().unwrap(), state, "{name}");
        let again = play(&mut *other, steps, &mut at.clone());
        assert!(again == seen, "{name} continues differently");
        for wrong in [&state[..state.len() - 1], &[]] {
            assert!(make().load(wrong).is_err(), "{name}: {} bytes", wrong.len());
        }
        ended
    }

    #[test]
    fn a_state_that_would_not_be_read_back_is_not_saved() {
        let long = encode(&" ".repeat(STATE_BYTES_MAX));
        fails(long, &["takes 268435461 bytes, and 268435456 can be saved"]);
    }

    fn chain() -> WorldConfig {
        WorldConfig::Chain(chain::tests::config())
    }

    fn ising(lattice_size: usize) -> WorldConfig {
        WorldConfig::Ising(IsingConfig {
            lattice_size,
            patch_size: 5,
            temperature: 2.0,
            ..ising::tests::paper_config()
        })
    }

    #[test]
    fn worlds_go_on_where_they_were_saved() {
        for (name, config) in [("chain", chain()), ("ising", ising(9))] {
            assert!(check_restore(name, 60, || config.build(ENVS, 3, 0).unwrap()) > 3);
        }
        let part = || {
            let whole = chain().build(ENVS, 3, 0).unwrap();
            RestrictedWorld::wrap(whole, vec![1, 2], (6, 11)).unwrap()
        };
        assert!(check_restore("a part of the chain", 60, part) > 3);
    }

    #[test]
    fn a_state_of_another_world_is_refused() {
        let state = |config: WorldConfig, envs| config.build(envs, 3, 0).unwrap().save();
        for (config, state) in [
            (chain(), state(chain(), 2)),
            (chain(), state(ising(9), ENVS)),
            (ising(9), state(ising(10), ENVS)),
            (ising(9), state(chain(), ENVS)),
        ] {
            let mut world = config.build(ENVS, 3, 0).unwrap();
            fails(world.load(&state.unwrap()), &["not a state of this world"]);
        }
    }
}
