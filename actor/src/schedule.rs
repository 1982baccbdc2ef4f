//! Epsilon, the probability of a random action: falling over the run, or fixed for each actor.
//! The schedule does not count frames: the caller passes the run's frame count.

use crate::{
    config::{Config, EpsilonLadder},
    error::ActError,
};

/// One actor's epsilon: linear over the frames of the whole run, then constant. Source: table of parameters in the paper's appendix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Epsilon at the run's first frame.
    pub start: f64,
    /// Epsilon from `decay_frames` on.
    pub end: f64,
    /// Frames over which epsilon falls, of all actors together.
    pub decay_frames: u64,
}

impl Schedule {
    /// The largest absolute error of [`Schedule::epsilon`], for any number of frames.
    pub const ERROR: f64 = 1e-15;

    /// Returns the schedule of actor number `actor`. On a ladder, its epsilon never changes. Source: Horgan et al. 2018.
    pub fn new(config: &Config, actor: u32) -> Result<Self, ActError> {
        let fixed = config.epsilon_ladder.as_ref();
        let fixed = fixed.map(|ladder| ladder_epsilon(ladder, actor));
        let fixed = fixed.transpose()?;
        Ok(Self {
            start: fixed.unwrap_or(config.epsilon_start),
            end: fixed.unwrap_or(config.epsilon_end),
            decay_frames: config.epsilon_decay_frames,
        })
    }

    /// Returns epsilon after `frames` frames of the run, to within [`Schedule::ERROR`]: between start and end, and monotonic in `frames`.
    pub fn epsilon(&self, frames: u64) -> f64 {
        let (start, end) = (self.start, self.end);
        if frames >= self.decay_frames {
            return end;
        }
        let epsilon = start + (end - start) * (frames as f64 / self.decay_frames as f64);
        // Just before `decay_frames`, rounding may carry epsilon past `end`.
        epsilon.clamp(start.min(end), start.max(end))
    }
}

/// `base^(1 + alpha * i / (N - 1))` for actor i of N.
fn ladder_epsilon(ladder: &EpsilonLadder, actor: u32) -> Result<f64, ActError> {
    let actors = ladder.actors;
    if actor >= actors {
        return Err(ActError::Other(format!(
            "actor {actor} is beyond the {actors} of actor.epsilon_ladder.actors, whose numbers begin at 0: start it with another --id, or \
             the replay server with --set actor.epsilon_ladder.actors={}",
            u64::from(actor) + 1
        )));
    }
    let fraction = f64::from(actor) / f64::from(actors - 1);
    Ok(ladder.base.powf(1.0 + ladder.alpha * fraction))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::tests::CONFIG;

    fn with_ladder(actors: u32) -> Config {
        Config {
            epsilon_ladder: Some(EpsilonLadder {
                base: 0.4,
                alpha: 7.0,
                actors,
            }),
            ..CONFIG
        }
    }

    #[test]
    fn without_a_ladder_all_actors_have_the_settings_line() {
        for actor in [0, 5] {
            let line = Schedule {
                start: 0.1,
                end: 0.01,
                decay_frames: 100_000,
            };
            assert_eq!(Schedule::new(&CONFIG, actor).unwrap(), line);
        }
    }

    /// Closed form: with alpha 7, eight actors have the powers 1, 2, .., 8 of 0.4.
    #[test]
    fn each_actor_has_its_rung_of_the_ladder_for_the_whole_run() {
        for actor in 0..8 {
            let schedule = Schedule::new(&with_ladder(8), actor).unwrap();
            let wanted = 0.4f64.powi(actor as i32 + 1);
            for frames in [0, 1, 100_000, u64::MAX] {
                let found = schedule.epsilon(frames);
                assert!((found - wanted).abs() < 1e-12, "{actor}: {found}");
            }
        }
        // The first and the last epsilon do not depend on the number of actors.
        for actors in [2, 3, 360] {
            for (actor, power) in [(0, 1), (actors - 1, 8)] {
                let schedule = Schedule::new(&with_ladder(actors), actor).unwrap();
                assert!((schedule.epsilon(7) - 0.4f64.powi(power)).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn an_actor_beyond_the_ladder_is_told_what_to_do() {
        let message = Schedule::new(&with_ladder(8), 9).unwrap_err().to_string();
        assert_eq!(
            message,
            "actor 9 is beyond the 8 of actor.epsilon_ladder.actors, whose numbers begin at 0: start it with another --id, or \
             the replay server with --set actor.epsilon_ladder.actors=10"
        );
        assert!(Schedule::new(&with_ladder(8), u32::MAX).is_err());
    }
}
