//! Numbers that others published on Procgen, from `published.csv`: the paper's returns, and those between which scores are normalised.
//! Nothing here is measured by us.

use std::collections::BTreeMap;

use serde::Deserialize;

const TABLE: &str = include_str!("published.csv");

/// A line of the table.
#[derive(Deserialize)]
struct Line {
    game: String,
    what: String,
    mean: f64,
    #[serde(rename = "sd")]
    _sd: Option<f64>,
}

/// The means by game and by what they are of.
pub(super) struct Published(BTreeMap<(String, String), f64>);

impl Published {
    /// Reads the table, which is built in.
    pub(super) fn read() -> Self {
        let mut reader = csv::ReaderBuilder::new();
        let mut reader = reader.comment(Some(b'#')).from_reader(TABLE.as_bytes());
        let lines = reader.deserialize::<Line>();
        let lines = lines.map(|line| line.expect("published.csv is built in, and a test reads it"));
        Self(
            lines
                .map(|line| ((line.game, line.what), line.mean))
                .collect(),
        )
    }

    /// The paper's training return of an agent in a game, both by their names on the command line; none for other worlds.
    pub(super) fn paper(&self, game: &str, agent: &str) -> Option<f64> {
        self.0.get(&(game.to_owned(), agent.to_owned())).copied()
    }

    /// `(return - min) / (max - min)` of single levels; none for worlds that are not Procgen's.
    pub(super) fn normalised(&self, game: &str, score: f64) -> Option<f64> {
        let [min, max] = ["easy-min", "easy-max"].map(|what| self.paper(game, what));
        let (min, max) = min.zip(max)?;
        Some((score - min) / (max - min))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both tables have every game: nine agents with the ablation's, and two ends.
    #[test]
    fn the_table_is_whole_and_is_read_by_name() {
        let published = Published::read();
        assert_eq!(published.0.len(), 16 * 11);
        for (game, agent, wanted) in [
            ("bigfish", "driml-ada", Some(4.45)),
            ("fruitbot", "driml-noact-k1", Some(0.714)),
            ("coinrun", "driml-ada", Some(22.88)),
            ("chain", "c51", None),
        ] {
            assert_eq!(published.paper(game, agent), wanted);
        }
        assert_eq!(published.normalised("fruitbot", -1.5), Some(0.0));
        assert_eq!(published.normalised("bossfight", 13.0), Some(1.0));
        assert_eq!(published.normalised("chain", 1.0), None);
    }
}
