//! Which of the fifteen actions do the same in each game: the alphabet for statistics over actions, and for `ActionSet::Visible`.
//! It does not change which actions the engine takes.

use procgen_sys::{Game, NUM_ACTIONS};

/// Maps each raw action to one that does the same in `game`. An action that does something else maps to itself; 4 is the no-op.
///
/// The table is that of the authors of Deep Reinforcement and InfoMax Learning (2020). The engine confirms it, by doing
/// each pair of actions in the same saved state and comparing all that follows, **except in ninja**: there 13 and 14 throw a star
/// as 9 does, instead of being no-ops, but the next frame does not show it yet. The table keeps the authors' entry.
/// It could also be coarser: in leaper 0 and 2 do what 1 does, and 6 and 8 what 7 does; in starpilot 11 to 14 do what 9
/// does. In caveflyer, dodgeball, fruitbot and ninja the effect of action 9 shows only after the next frame.
pub fn visible_actions(game: Game) -> [u8; NUM_ACTIONS] {
    let [left, no_op, right]: [&[usize]; 3] = match game {
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
    for (raw, visible) in [(left, 1), (no_op, 4), (right, 7)] {
        raw.iter().for_each(|&action| table[action] = visible);
    }
    table
}
