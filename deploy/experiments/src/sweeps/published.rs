//! Published numbers on Procgen, from `published.csv`: the paper's returns, and the returns that scores are normalised between.
//! None of them was measured with this program.

/// A line for each game. A cell has the mean, and the standard deviation if it was published.
const TABLE: &str = include_str!("published.csv");

/// Returns the lines of the table as cells, beginning with the header.
fn rows() -> impl Iterator<Item = Vec<&'static str>> {
    let lines = TABLE.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| line.split(',').collect())
}

/// Returns the paper's training return of an agent in a game, both by their command-line names; `None` for other worlds or agents.
pub(super) fn paper_return(game: &str, agent: &str) -> Option<f64> {
    let column = rows().next()?.iter().position(|name| *name == agent)?;
    let line = rows().find(|line| line[0] == game)?;
    let mean = line[column].split(' ').next()?;
    Some(mean.parse().expect("it is built in, and a test reads it"))
}

/// Normalises a return on single levels: `(return - min) / (max - min)`. `None` for worlds other than Procgen, and other modes than easy.
pub(super) fn normalise(game: &str, mode: &str, score: f64) -> Option<f64> {
    let [min, max] = ["min", "max"].map(|end| paper_return(game, &format!("{mode}-{end}")));
    let (min, max) = min.zip(max)?;
    Some((score - min) / (max - min))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every game has eleven numbers: nine agents, including those of the ablation, and the two ends of the normalisation.
    #[test]
    fn the_table_is_whole_and_is_read_by_name() {
        let header = rows().next().unwrap();
        assert_eq!((header.len(), rows().skip(1).count()), (1 + 11, 16));
        for line in rows().skip(1) {
            let is_read = |what: &&str| paper_return(line[0], what).is_some();
            assert!(header[1..].iter().all(is_read), "{line:?}");
        }
        for (game, agent, wanted) in [
            ("bigfish", "driml-ada", Some(4.45)),
            ("fruitbot", "driml-noact-k1", Some(0.714)),
            ("coinrun", "driml-ada", Some(22.88)),
            ("chain", "c51", None),
        ] {
            assert_eq!(paper_return(game, agent), wanted);
        }
        assert_eq!(normalise("fruitbot", "easy", -1.5), Some(0.0));
        assert_eq!(normalise("bossfight", "easy", 13.0), Some(1.0));
        assert_eq!(normalise("bossfight", "hard", 13.0), None);
    }
}
