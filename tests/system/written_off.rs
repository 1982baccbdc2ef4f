//! Chunks in shared memory that zenoh has written off: the replay server does not receive them, and the actor sends them through the socket.
//! On a busy machine zenoh does this if its threads get no processor for 100 ms; the test does it by hand.

use std::{
    fs::{self, File},
    os::unix::fs::FileExt,
    time::{Duration, Instant},
};

use driml_actor::{Delivery, DeliveryLimits};
use driml_protocol::{
    ActorJoin, BufferPool, Chunk, Shutdown, is_readable, shared_memory::METADATA_BYTES,
};
use driml_tests::{skip, wait_until};
use nix::sys::signal::Signal;
use zenoh::bytes::ZBytes;

use crate::{LONG, system, tiny_replay};

/// How long an actor waits for a reply before it sends its chunk again.
const ACK_TIMEOUT: Duration = Duration::from_secs(120);

/// zenoh's headers of the pieces of one pool.
struct Headers {
    file: File,
    /// zenoh's number of the pool's memory.
    pool: [u8; 4],
}

impl Headers {
    /// The length of one header: 4 bytes count the references, and the next byte is 1 if the memory is written off.
    const LEN: usize = 32;
    const COUNT: usize = 1 << 15;
    /// More references than any message has.
    const MARK: u32 = 1000;

    /// Finds the headers of the pool of `piece` among those of all processes whose memory this process reads.
    fn of(piece: &ZBytes) -> Self {
        let piece = piece.as_shm().unwrap();
        let _clones = vec![piece.to_owned(); Self::MARK as usize];
        let maps = fs::read_to_string("/proc/self/maps").unwrap();
        let paths = maps
            .lines()
            .filter_map(|line| line.split_whitespace().last());
        let mut files = paths.filter(|path| {
            let is_long_enough = |it: fs::Metadata| it.len() == METADATA_BYTES as u64;
            path.ends_with(".zenoh") && fs::metadata(path).is_ok_and(is_long_enough)
        });
        let found = files.find_map(|path| {
            let file = File::options().read(true).write(true).open(path).ok()?;
            let mut headers = Self::read(&file).into_iter();
            let marked = headers.find(|it| references(it) > Self::MARK)?;
            let pool = marked[16..20].try_into().unwrap();
            Some(Self { file, pool })
        });
        found.expect("zenoh's headers look different")
    }

    fn read(file: &File) -> Vec<[u8; Self::LEN]> {
        let mut bytes = vec![0; Self::COUNT * Self::LEN];
        file.read_exact_at(&mut bytes, 0).unwrap();
        bytes.as_chunks().0.to_vec()
    }

    /// Returns the position of each piece that is in use, and the number of references to it.
    fn pieces(&self) -> Vec<(usize, u32)> {
        let headers = Self::read(&self.file).into_iter().enumerate();
        let of_pool = headers.filter(|(_, it)| it[16..20] == self.pool && references(it) > 0);
        of_pool
            .map(|(place, it)| (place, references(&it)))
            .collect()
    }

    /// Writes off all pieces that are in use.
    fn write_off(&self) {
        for (place, _) in self.pieces() {
            let is_written_off = (place * Self::LEN + 4) as u64;
            self.file.write_all_at(&[1], is_written_off).unwrap();
        }
    }
}

/// Returns the number of references to the piece of a header.
fn references(header: &[u8; Headers::LEN]) -> u32 {
    u32::from_ne_bytes([header[0], header[1], header[2], header[3]])
}

#[test]
fn a_chunk_whose_shared_memory_is_written_off_is_stored_without_a_time_out() {
    let system = system();
    let _server = system.start_replay_server(&format!("--agent c51 {LONG}"));
    let client = system.connect();
    let server = system.find_process("replay-server");
    let limits = DeliveryLimits {
        chunks_in_flight_max: 4,
        ack_timeout: ACK_TIMEOUT,
        unreachable_max: 2 * ACK_TIMEOUT,
    };
    let header = |actor| tiny_replay::header(&client.spec, actor, 4, 8);
    let bytes = header(0).payload_bytes().unwrap();
    let pool = BufferPool::shared(4, 4, bytes);
    for (actor, is_sent_before) in [(0, false), (1, true)] {
        let mut payload = pool.take(bytes);
        if !payload.is_shared() {
            return skip("no shared memory");
        }
        payload.fill(0);
        client.join_as_actor(actor, 1);
        let (run, join) = (system.run_client(&client.spec), ActorJoin::new(actor, 1));
        let delivery = Delivery::start(run, join, 0, limits, pool.clone(), Shutdown::default());
        let (delivery, started) = (delivery.unwrap(), Instant::now());
        let another = pool.take(1).freeze();
        let headers = Headers::of(&another);
        assert!(is_readable(&another));
        let chunk = Chunk::with_buffer(header(actor), payload);
        if is_sent_before {
            // The server reads the message after the memory has been written off.
            server.suspend();
            assert!(delivery.send(chunk));
            let is_sent = || headers.pieces().iter().any(|it| it.1 > 1);
            wait_until("a chunk is on its way", is_sent);
            headers.write_off();
            server.signal(Signal::SIGCONT);
        } else {
            headers.write_off();
            assert!(delivery.send(chunk));
        }
        assert!(!is_readable(&another), "zenoh's headers look different");
        assert_eq!(delivery.finish(false).unwrap(), 0);
        assert!(started.elapsed() < ACK_TIMEOUT, "actor {actor}");
    }
    let status = client.check_nothing_lost();
    assert_eq!(status.transitions_inserted, 64, "{status:#?}");
    assert_eq!((status.chunks_retried, status.messages_refused), (0, 0));
}
