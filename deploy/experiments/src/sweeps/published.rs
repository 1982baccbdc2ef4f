//! Numbers that others published on Procgen, from `published.csv`: the paper's returns, and those between which scores are normalised.
//! Nothing here is measured by us.

/// Lines of a game, what it is of, its mean, and its standard deviation where that was published.
const TABLE: &str = include_str!("published.csv");

/// The paper's training return of an agent in a game, both by their names on the command line; none for other worlds.
pub(super) fn paper(game: &str, agent: &str) -> Option<f64> {
    let mut lines = TABLE
        .lines()
        .map(|line| line.split(',').collect::<Vec<_>>());
    let line = lines.find(|line| line.get(..2) == Some(&[game, agent]))?;
    Some(
        line[2]
            .parse()
            .expect("it is built in, and a test reads it"),
    )
}

/// `(return - min) / (max - min)` of single levels; none for worlds that are not Procgen's.
pub(super) fn normalised(game: &str, score: f64) -> Option<f64> {
    let [min, max] = ["easy-min", "easy-max"].map(|what| paper(game, what));
    let (min, max) = min.zip(max)?;
    Some((score - min) / (max - min))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Both tables have every game: nine agents with the ablation's, and two ends.
    #[test]
    fn the_table_is_whole_and_is_read_by_name() {
        let lines = TABLE.lines().filter(|line| !line.starts_with('#')).skip(1);
        let keys: BTreeSet<_> = lines
            .map(|line| {
                let words: Vec<_> = line.split(',').collect();
                assert!(paper(words[0], words[1]).is_some(), "{line}");
                (words[0], words[1])
            })
            .collect();
        assert_eq!(keys.len(), 16 * 11);
        for (game, agent, wanted) in [
            ("bigfish", "driml-ada", Some(4.45)),
            ("fruitbot", "driml-noact-k1", Some(0.714)),
            ("coinrun", "driml-ada", Some(22.88)),
            ("chain", "c51", None),
        ] {
            assert_eq!(paper(game, agent), wanted);
        }
        assert_eq!(normalised("fruitbot", -1.5), Some(0.0));
        assert_eq!(normalised("bossfight", 13.0), Some(1.0));
        assert_eq!(normalised("chain", 1.0), None);
    }
}
