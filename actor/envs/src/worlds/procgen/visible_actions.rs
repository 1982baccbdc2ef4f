//! What each of the fifteen actions amounts to in each game.
//! It does not change what the engine is given; it is an alphabet for statistics over actions.

use procgen_sys::{Game, NUM_ACTIONS};

/// For each raw action, the one that it amounts to; an action that stands for itself maps to itself, 4 is no-op.
///
/// The table is that of the authors of Deep Reinforcement and InfoMax Learning (2020). The engine confirms it, by doing
/// each pair of actions in the same saved state and comparing all that follows, **except in ninja**: there 13 and 14 are
/// no no-ops but throw a star as 9 does, which the next frame does not show yet. The table keeps the authors' entry.
/// It could also be coarser: in leaper 0 and 2 do what 1 does, and 6 and 8 what 7 does; in starpilot 11 to 14 do what 9
/// does. In caveflyer, dodgeball, fruitbot and ninja the effect of action 9 shows only after the next frame.
pub fn visible_actions(game: Game) -> [u8; NUM_ACTIONS] {
    let [left, still, right]: [&[usize]; 3] = match game {
        Game::Bigfish | Game::Chaser | Game::Coinrun | Game::Heist | Game::Leaper => {
            [&[], &[9, 10, 11, 12, 13, 14], &[]]
        }
        Game::Bossfight | Game::Caveflyer | Game::Dodgeball => [&[], &[10, 11, 12, 13, 14], &[]],
        Game::Climber | Game::Jumper => [&[0], &[3, 9, 10, 11, 12, 13, 14], &[6]],
        Game::Fruitbot | Game::Plunder => [&[0, 2], &[3, 5, 10, 11, 12, 13, 14], &[6, 8]],
        Game::Maze | Game::Miner => [&[0, 2], &[9, 10, 11, 12, 13, 14], &[6, 8]],
        Game::Ninja => [&[0], &[3, 13, 14], &[6]],
        Game::Starpilot => [&[], &[], &[]],
    };
    let mut table: [u8; NUM_ACTIONS] = std::array::from_fn(|action| action as u8);
    for (raw, visible) in [(left, 1), (still, 4), (right, 7)] {
        raw.iter().for_each(|&action| table[action] = visible);
    }
    table
}
