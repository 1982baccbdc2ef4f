//! Numbers that others published on Procgen: the paper's table 1, and the returns between which scores are normalised.
//! Nothing here is measured by us.

use procgen_sys::Game;

/// The paper's agents, in the order of its table 1.
pub(super) const AGENTS: [&str; 7] = [
    "c51",
    "cpc",
    "curl",
    "driml-noact",
    "driml-randk",
    "driml-fix",
    "driml-ada",
];

/// Mean and standard deviation over three seeds of the training return after 50 million frames, in the order of [`AGENTS`].
/// Source: Mazoure et al. 2020, table 1.
#[rustfmt::skip]
const TABLE_1: [(&str, [(f64, f64); 7]); 16] = [
    ("bigfish", [(1.33, 0.12), (1.17, 0.16), (2.70, 1.30), (1.19, 0.04), (1.12, 1.03), (2.02, 0.18), (4.45, 0.71)]),
    ("bossfight", [(0.57, 0.05), (0.52, 0.07), (0.60, 0.06), (0.47, 0.01), (0.56, 0.03), (0.67, 0.02), (1.05, 0.19)]),
    ("caveflyer", [(9.19, 0.29), (6.40, 0.56), (6.94, 0.25), (8.26, 0.26), (7.92, 0.15), (10.2, 0.41), (6.77, 0.04)]),
    ("chaser", [(0.22, 0.04), (0.21, 0.02), (0.35, 0.04), (0.23, 0.02), (0.26, 0.01), (0.29, 0.02), (0.38, 0.04)]),
    ("climber", [(1.68, 0.10), (1.71, 0.11), (1.75, 0.09), (1.57, 0.01), (2.21, 0.48), (2.26, 0.05), (2.20, 0.08)]),
    ("coinrun", [(29.7, 5.44), (11.4, 1.55), (21.2, 1.94), (13.2, 1.21), (21.6, 1.97), (27.2, 1.92), (22.88, 0.4)]),
    ("dodgeball", [(1.20, 0.08), (1.05, 0.04), (1.09, 0.04), (1.22, 0.04), (1.19, 0.03), (1.28, 0.02), (1.44, 0.06)]),
    ("fruitbot", [(3.86, 0.96), (4.56, 0.93), (4.89, 0.71), (5.42, 1.33), (6.84, 0.24), (5.40, 1.02), (9.53, 0.29)]),
    ("heist", [(1.54, 0.10), (0.93, 0.08), (1.06, 0.05), (1.04, 0.02), (1.00, 0.05), (1.30, 0.05), (1.89, 0.02)]),
    ("jumper", [(13.2, 0.83), (2.28, 0.44), (10.3, 0.61), (4.31, 0.64), (5.62, 0.27), (12.6, 0.64), (12.2, 0.42)]),
    ("leaper", [(5.03, 0.14), (4.01, 0.71), (3.94, 0.46), (5.40, 0.09), (4.24, 1.17), (6.17, 0.29), (6.35, 0.46)]),
    ("maze", [(2.36, 0.09), (1.14, 0.08), (0.82, 0.20), (1.44, 0.26), (1.18, 0.03), (1.38, 0.08), (2.62, 0.10)]),
    ("miner", [(0.13, 0.01), (0.13, 0.02), (0.10, 0.01), (0.12, 0.01), (0.15, 0.01), (0.14, 0.01), (0.19, 0.02)]),
    ("ninja", [(9.36, 0.01), (6.23, 0.82), (5.84, 1.21), (6.44, 0.22), (8.13, 0.26), (9.21, 0.25), (8.74, 0.28)]),
    ("plunder", [(2.99, 0.07), (3.00, 0.06), (2.77, 0.14), (3.20, 0.05), (3.34, 0.09), (3.37, 0.17), (3.58, 0.04)]),
    ("starpilot", [(2.44, 0.12), (2.87, 0.05), (2.68, 0.09), (3.70, 0.30), (3.93, 0.04), (4.56, 0.21), (2.63, 0.16)]),
];

/// Mean and standard deviation of the training return of DRIML-noact with k = 1 and with k = 5, after 50 million frames.
/// Source: Mazoure et al. 2020, appendix, "Ablation of the impact of predictive timestep".
#[rustfmt::skip]
const ABLATION: [(&str, [(f64, f64); 2]); 16] = [
    ("bigfish", [(1.193, 0.04), (1.33, 0.12)]),
    ("bossfight", [(0.466, 0.07), (0.472, 0.01)]),
    ("caveflyer", [(8.263, 0.26), (5.925, 0.18)]),
    ("chaser", [(0.224, 0.01), (0.229, 0.02)]),
    ("climber", [(1.359, 0.13), (1.574, 0.01)]),
    ("coinrun", [(13.146, 1.21), (9.632, 2.8)]),
    ("dodgeball", [(1.221, 0.04), (1.213, 0.09)]),
    ("fruitbot", [(0.714, 0.31), (5.425, 1.33)]),
    ("heist", [(1.042, 0.02), (0.861, 0.07)]),
    ("jumper", [(2.966, 0.1), (4.314, 0.64)]),
    ("leaper", [(5.403, 0.09), (3.521, 0.3)]),
    ("maze", [(0.984, 0.13), (1.438, 0.26)]),
    ("miner", [(0.11, 0.01), (0.116, 0.01)]),
    ("ninja", [(6.437, 0.22), (5.9, 0.38)]),
    ("plunder", [(2.67, 0.08), (3.2, 0.05)]),
    ("starpilot", [(3.699, 0.3), (2.951, 0.31)]),
];

/// Mean and standard deviation that the paper has for a world and an agent, both by their names on the command line: table 1, or
/// the ablation's for DRIML-noact with a k of its own.
pub(super) fn paper(world: &str, agent: &str) -> Option<(f64, f64)> {
    let game = world.strip_prefix("procgen:")?;
    if let Some(column) = ["driml-noact-k1", "driml-noact-k5"]
        .iter()
        .position(|name| *name == agent)
    {
        let row = ABLATION.iter().find(|(name, _)| *name == game)?;
        return Some(row.1[column]);
    }
    let column = AGENTS.iter().position(|name| *name == agent)?;
    let row = TABLE_1.iter().find(|(name, _)| *name == game)?;
    Some(row.1[column])
}

/// The returns that count as 0 and as 1, in mode "easy", for single levels.
/// Source: Cobbe et al. 2020, "Leveraging Procedural Generation to Benchmark Reinforcement Learning", appendix C.
const fn range(game: Game) -> (f64, f64) {
    match game {
        Game::Bigfish => (1.0, 40.0),
        Game::Bossfight | Game::Chaser => (0.5, 13.0),
        Game::Caveflyer => (3.5, 12.0),
        Game::Climber => (2.0, 12.6),
        Game::Coinrun | Game::Maze => (5.0, 10.0),
        Game::Dodgeball => (1.5, 19.0),
        Game::Fruitbot => (-1.5, 32.4),
        Game::Heist | Game::Ninja => (3.5, 10.0),
        Game::Jumper | Game::Leaper => (3.0, 10.0),
        Game::Miner => (1.5, 13.0),
        Game::Plunder => (4.5, 30.0),
        Game::Starpilot => (2.5, 64.0),
    }
}

/// `(return - min) / (max - min)`; none for worlds that are not Procgen's.
pub(super) fn normalised(world: &str, score: f64) -> Option<f64> {
    let name = world.strip_prefix("procgen:")?;
    let game = Game::ALL.into_iter().find(|game| game.name() == name)?;
    let (min, max) = range(game);
    Some((score - min) / (max - min))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::aggregate::norm_scores;

    #[test]
    fn the_formula_of_the_norm_score_gives_the_paper_s_last_row() {
        let games = TABLE_1.map(|(_, row)| row.map(|(mean, _)| mean).to_vec());
        let found = norm_scores(&games, 0).unwrap();
        // Printed with two digits.
        for (found, paper) in found.iter().zip([1.0, 0.23, 0.52, 0.59, 0.92, 1.48, 1.9]) {
            assert!((found - paper).abs() < 0.015, "{found} for {paper}");
        }
    }

    /// Cobbe et al. 2020, appendix C, table of normalisation constants, columns "easy", line by line.
    #[test]
    fn the_ranges_are_the_published_ones() {
        let published = [
            ("coinrun", 5.0, 10.0),
            ("starpilot", 2.5, 64.0),
            ("caveflyer", 3.5, 12.0),
            ("dodgeball", 1.5, 19.0),
            ("fruitbot", -1.5, 32.4),
            ("chaser", 0.5, 13.0),
            ("miner", 1.5, 13.0),
            ("jumper", 3.0, 10.0),
            ("leaper", 3.0, 10.0),
            ("maze", 5.0, 10.0),
            ("bigfish", 1.0, 40.0),
            ("heist", 3.5, 10.0),
            ("climber", 2.0, 12.6),
            ("plunder", 4.5, 30.0),
            ("ninja", 3.5, 10.0),
            ("bossfight", 0.5, 13.0),
        ];
        let mut found = Game::ALL.map(|game| (game.name(), range(game)));
        let mut wanted = published.map(|(name, min, max)| (name, (min, max)));
        found.sort_by_key(|(name, _)| *name);
        wanted.sort_by_key(|(name, _)| *name);
        assert_eq!(found, wanted);
        assert_eq!(normalised("procgen:fruitbot", 15.45), Some(0.5));
    }

    #[test]
    fn every_game_is_in_both_tables() {
        for game in Game::ALL {
            let world = format!("procgen:{game}");
            let (min, max) = range(game);
            assert_eq!(normalised(&world, min), Some(0.0));
            assert_eq!(normalised(&world, max), Some(1.0));
            for agent in AGENTS
                .into_iter()
                .chain(["driml-noact-k1", "driml-noact-k5"])
            {
                assert!(paper(&world, agent).is_some(), "{world} {agent}");
            }
        }
        for (agent, wanted) in [
            ("driml-ada", (4.45, 0.71)),
            ("driml-fix", (2.02, 0.18)),
            ("driml-noact-k5", (1.33, 0.12)),
        ] {
            assert_eq!(paper("procgen:bigfish", agent), Some(wanted));
        }
        assert_eq!(
            (paper("chain", "c51"), normalised("chain", 1.0)),
            (None, None)
        );
    }
}
