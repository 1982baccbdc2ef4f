//! The maze of Ms. PacMan: its walls, food and starts, which cells see each other, and the distances between them.
//! It knows nothing of the agent and the ghosts. The layout was drawn for this project; it is not the arcade's.

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use crate::worlds::ising::{Boundary, neighbours_of};

/// Rows of the maze, one pixel each.
pub(crate) const HEIGHT: usize = 21;
/// Columns of the maze, one pixel each.
pub(crate) const WIDTH: usize = 19;
/// Number of ghosts, each with its own start.
pub(crate) const GHOSTS: usize = 4;
/// Ways out of a cell: up, down, left, right.
pub(crate) const DIRECTIONS: usize = 4;

/// `#` wall, `.` pellet, `o` boost, `@` the agent's start, `1`-`4` the ghosts' starts. Row 9 is a tunnel.
const LAYOUT: [&[u8; WIDTH]; HEIGHT] = [
    b"###################",
    b"#o....#.....#....o#",
    b"#.###.#.###.#.###.#",
    b"#...#.........#...#",
    b"###.#.###.###.#.###",
    b"#.......#.#.......#",
    b"#.###.#.#.#.#.###.#",
    b"#.###.........###.#",
    b"#.###.###1###.###.#",
    b"......##234##......",
    b"###.#.#######.#.###",
    b"#...#.........#...#",
    b"#.#.###.###.###.#.#",
    b"#.#.............#.#",
    b"#.###.###.###.###.#",
    b"#.....#..@..#.....#",
    b"###.#.#.###.#.#.###",
    b"#o..#.........#..o#",
    b"#.#####.###.#####.#",
    b"#.................#",
    b"###################",
];

pub(crate) static MAZE: LazyLock<Maze> = LazyLock::new(Maze::new);

/// A way out of a cell; `direction ^ 1` is its opposite.
pub(crate) type Direction = u8;

/// An open cell, by its number in row order: 0..places.
pub(crate) type Place = u16;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Item {
    Nothing,
    Pellet,
    Boost,
}

/// The maze, with everything about it that a step looks up.
pub(crate) struct Maze {
    /// Open cell -> pixel, in row order.
    pixels: Vec<u16>,
    /// Open cell and direction -> the open cell there, or the same one where a wall is.
    next: Vec<[Place; DIRECTIONS]>,
    /// Open cell -> bit d is set where direction d is open.
    exits: Vec<u8>,
    /// Open cell -> first pixel of its unbroken run of open cells in its row, and in its column.
    runs: Vec<(u16, u16)>,
    /// [places, places]: moves on the shortest way between two open cells.
    distances: Vec<u8>,
    /// What lies in each open cell at the start of an episode.
    pub(crate) items: Vec<Item>,
    /// Pellets at the start of an episode.
    pub(crate) pellets: u32,
    pub(crate) agent_start: Place,
    pub(crate) ghost_starts: [Place; GHOSTS],
}

impl Maze {
    fn new() -> Self {
        let cell = |pixel: usize| LAYOUT[pixel / WIDTH][pixel % WIDTH];
        let pixels: Vec<u16> = (0..(HEIGHT * WIDTH) as u16)
            .filter(|&p| cell(p.into()) != b'#')
            .collect();
        let place = |pixel: usize| {
            let found = pixels.binary_search(&(pixel as u16));
            found.ok().map(|place| place as Place)
        };
        let start = |mark: u8| {
            let pixel = (0..HEIGHT * WIDTH)
                .find(|&pixel| cell(pixel) == mark)
                .expect("the layout marks every start");
            place(pixel).expect("a start is an open cell")
        };
        let next_of = |from: usize| {
            let around = neighbours_of(pixels[from].into(), HEIGHT, WIDTH, Boundary::Periodic);
            around.map(|pixel| place(pixel as usize).unwrap_or(from as Place))
        };
        let next: Vec<_> = (0..pixels.len()).map(next_of).collect();
        let open = |from: usize| {
            let bit = |d| u8::from(usize::from(next[from][d]) != from) << d;
            (0..DIRECTIONS).map(bit).sum()
        };
        let item = |&pixel: &u16| match cell(pixel.into()) {
            b'.' => Item::Pellet,
            b'o' => Item::Boost,
            _ => Item::Nothing,
        };
        let items: Vec<Item> = pixels.iter().map(item).collect();
        Self {
            exits: (0..pixels.len()).map(open).collect(),
            runs: pixels.iter().map(|&it| run_starts(it.into())).collect(),
            distances: (0..pixels.len())
                .flat_map(|from| distances_from(from, &next))
                .collect(),
            pellets: items.iter().filter(|&&item| item == Item::Pellet).count() as u32,
            items,
            agent_start: start(b'@'),
            ghost_starts: [b'1', b'2', b'3', b'4'].map(start),
            next,
            pixels,
        }
    }

    /// The open cells.
    pub(crate) fn places(&self) -> std::ops::Range<Place> {
        0..self.pixels.len() as Place
    }

    /// The pixel of an open cell, row * 19 + column.
    pub(crate) fn pixel(&self, place: Place) -> usize {
        self.pixels[usize::from(place)].into()
    }

    /// Returns the cell to which one move leads. A move into a wall stays in its cell.
    pub(crate) fn next(&self, place: Place, direction: Direction) -> Place {
        self.next[usize::from(place)][usize::from(direction)]
    }

    /// The ways out of a cell: bit d for direction d. Never 0.
    pub(crate) fn exits(&self, place: Place) -> u8 {
        self.exits[usize::from(place)]
    }

    /// Whether two open cells are in one row or column with no wall between. The tunnel cannot be looked through.
    pub(crate) fn in_sight(&self, a: Place, b: Place) -> bool {
        let (a, b) = (self.runs[usize::from(a)], self.runs[usize::from(b)]);
        a.0 == b.0 || a.1 == b.1
    }

    /// Moves on the shortest way from one open cell to another.
    pub(crate) fn distance(&self, a: Place, b: Place) -> u8 {
        self.distances[usize::from(a) * self.pixels.len() + usize::from(b)]
    }

    /// [H * W]: whether each pixel is wall.
    pub(crate) fn walls(&self) -> Vec<bool> {
        let rows = LAYOUT.iter();
        rows.flat_map(|row| row.map(|c| c == b'#')).collect()
    }
}

/// The pixel in which the run of open cells through `pixel` begins: along its row, and along its column.
fn run_starts(pixel: usize) -> (u16, u16) {
    let (row, column) = (pixel / WIDTH, pixel % WIDTH);
    let left = (0..column).rev().find(|&c| LAYOUT[row][c] == b'#');
    let top = (0..row).rev().find(|&r| LAYOUT[r][column] == b'#');
    let [left, top] = [left, top].map(|wall| wall.map_or(0, |wall| wall + 1));
    ((row * WIDTH + left) as u16, (top * WIDTH + column) as u16)
}

/// The number of moves from one open cell to each, by breadth-first search; `u8::MAX` for cells out of reach.
fn distances_from(from: usize, next: &[[Place; DIRECTIONS]]) -> Vec<u8> {
    let mut distances = vec![u8::MAX; next.len()];
    distances[from] = 0;
    let mut queue = std::collections::VecDeque::from([from]);
    while let Some(here) = queue.pop_front() {
        for there in next[here].map(usize::from) {
            if distances[there] == u8::MAX {
                distances[there] = distances[here] + 1;
                queue.push_back(there);
            }
        }
    }
    distances
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The open cell in this row and column.
    pub(crate) fn at(row: usize, column: usize) -> Place {
        let pixel = row * WIDTH + column;
        MAZE.places().find(|&p| MAZE.pixel(p) == pixel).unwrap()
    }

    #[test]
    fn every_open_cell_is_reachable_and_the_food_is_counted() {
        let places = MAZE.items.len();
        let reached = |place| MAZE.distance(MAZE.agent_start, place) < u8::MAX;
        assert!(MAZE.places().all(reached));
        let boosts = MAZE.items.iter().filter(|&&item| item == Item::Boost);
        assert_eq!((places, MAZE.pellets, boosts.count()), (196, 187, 4));
        assert_eq!(MAZE.walls().iter().filter(|&&wall| !wall).count(), places);
    }

    #[test]
    fn only_the_house_has_dead_ends_and_only_the_tunnel_leaves_the_rim() {
        let house = MAZE.ghost_starts;
        for place in MAZE.places() {
            let a = MAZE.pixel(place);
            let is_dead_end = MAZE.exits(place).count_ones() < 2;
            assert!(!is_dead_end || house.contains(&place), "pixel {a}");
            for direction in 0..4 {
                let there = MAZE.next(place, direction);
                let is_undone = MAZE.next(there, direction ^ 1) == place;
                assert!(there == place || is_undone, "pixel {a}");
                let b = MAZE.pixel(there);
                let (row, is_in_row) = (a / WIDTH, a / WIDTH == b / WIDTH);
                let is_in_line = is_in_row || a % WIDTH == b % WIDTH;
                assert!(a.abs_diff(b) <= WIDTH && is_in_line, "pixel {a}");
                let around = is_in_row && a.abs_diff(b) > 1;
                assert!(!around || row == 9, "a second tunnel in row {row}");
            }
        }
    }

    #[test]
    fn sight_is_a_straight_line_without_walls() {
        assert!(MAZE.in_sight(at(19, 1), at(19, 17)));
        assert!(MAZE.in_sight(at(1, 5), at(11, 5)));
        assert!(!MAZE.in_sight(at(1, 5), at(1, 7)), "a wall between");
        assert!(!MAZE.in_sight(at(1, 1), at(3, 3)), "neither row nor column");
        assert!(!MAZE.in_sight(at(9, 0), at(9, 18)), "through the tunnel");
        assert_eq!(MAZE.distance(at(9, 0), at(9, 18)), 1);
        assert_eq!(MAZE.distance(at(19, 1), at(19, 17)), 16);
    }
}
