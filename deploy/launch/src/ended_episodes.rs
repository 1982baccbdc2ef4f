//! Fetches the episodes that ended, each once, from every shard of the replay.
//! What becomes of them is the recorder's business.

use driml_protocol::EpisodesReply;

/// Answers that are asked of one shard at a time; what they do not hold comes the next time.
const ASKS_MAX: usize = 16;

/// Episodes that ended since they were taken last.
#[derive(Clone, Debug, Default)]
pub(crate) struct EndedEpisodes {
    /// How many of each shard are known.
    known: Vec<u64>,
    /// Those that were not taken yet, each answer with its shard.
    fresh: Vec<(usize, EpisodesReply)>,
}

impl EndedEpisodes {
    /// Asks `shard`, of which `ended` have ended by its last status, for those that are not known yet. The file of episodes then holds
    /// as many as the row of metrics of that status counts.
    ///
    /// # Errors
    /// That of `ask`.
    pub(crate) fn fetch<E>(
        &mut self,
        shard: usize,
        ended: u64,
        mut ask: impl FnMut(u64) -> Result<EpisodesReply, E>,
    ) -> Result<(), E> {
        if self.known.len() <= shard {
            self.known.resize(shard + 1, 0);
        }
        // A server that knows of fewer counts anew.
        if ended < self.known[shard] {
            self.known[shard] = 0;
        }
        for _ in 0..ASKS_MAX {
            if self.known[shard] >= ended {
                break;
            }
            let mut reply = ask(self.known[shard])?;
            if reply.ended < ended || reply.before < self.known[shard] {
                break;
            }
            let wanted = ended.saturating_sub(reply.before) as usize;
            reply.episodes.truncate(wanted);
            reply.ended = ended.max(reply.up_to());
            self.known[shard] = reply.up_to().max(self.known[shard] + 1);
            self.fresh.push((shard, reply));
        }
        Ok(())
    }

    /// Those that are new.
    pub(crate) fn take(&mut self) -> Vec<(usize, EpisodesReply)> {
        std::mem::take(&mut self.fresh)
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use driml_protocol::EndedEpisode;

    use super::*;

    /// A server of which `ended` episodes have ended and the last `kept` are kept, three an answer.
    fn server(ended: u64, kept: u64) -> impl Fn(u64) -> Result<EpisodesReply, Infallible> {
        move |since| {
            let before = since.clamp(ended - kept, ended);
            let episodes = (before..ended).take(3).map(|n| EndedEpisode {
                frames: n,
                actor: 0,
                copy: 0,
                played: None,
            });
            Ok(EpisodesReply {
                ended,
                before,
                episodes: episodes.collect(),
            })
        }
    }

    fn frames(episodes: &mut EndedEpisodes) -> Vec<u64> {
        let taken = episodes.take();
        let all = taken.iter().flat_map(|(_, reply)| &reply.episodes);
        all.map(|it| it.frames).collect()
    }

    #[test]
    fn each_episode_comes_once_and_none_before_its_status() {
        let mut episodes = EndedEpisodes::default();
        // One more has ended since the status.
        let Ok(()) = episodes.fetch(0, 7, server(8, 8));
        assert_eq!(frames(&mut episodes), [0, 1, 2, 3, 4, 5, 6]);
        let Ok(()) = episodes.fetch(0, 7, server(8, 8));
        assert!(frames(&mut episodes).is_empty());
        let Ok(()) = episodes.fetch(0, 20, server(20, 4));
        assert_eq!(frames(&mut episodes), [16, 17, 18, 19]);
        // It was started anew.
        let Ok(()) = episodes.fetch(0, 2, server(2, 2));
        assert_eq!(frames(&mut episodes), [0, 1]);
    }
}
