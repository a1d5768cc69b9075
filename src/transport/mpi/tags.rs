//! Tags of the messages of a world. MPI promises 32767 of them.

/// A process begins as a worker of a crew.
pub(super) const BEGIN: i32 = 1;
/// A process leaves the world.
pub(super) const LEAVE: i32 = 2;
/// A worker is given up.
pub(super) const CUT: i32 = 3;
/// Signs of life.
pub(super) const ALIVE: i32 = 4;
/// The control channel, from the coordinator to a worker.
pub(super) const DOWN: i32 = 5;
/// The control channel, from a worker to the coordinator.
pub(super) const UP: i32 = 6;

/// A process has been told to leave, and sends nothing more.
pub(super) const GONE: i32 = 7;

/// First tag of data, and number of connections with tags of their own. After that many they come again, when nothing
/// of the first one is left.
const DATA: i32 = 16;
const CONNECTIONS: u32 = 8160;

/// Tags of the exchanges and of the all-gathers of connection number `connection`: between all its ranks, and between
/// those of one host.
pub(super) fn of_connection(connection: u32) -> [[i32; 2]; 2] {
    let first = DATA + 4 * (connection % CONNECTIONS) as i32;
    [[first, first + 1], [first + 2, first + 3]]
}
