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

use crate::{LONG, system, tiny_replay};

/// How long an actor waits for a reply before it sends its chunk again.
const ACK_TIMEOUT: Duration = Duration::from_secs(120);

/// zenoh's headers of the shared memory of this process.
struct Headers(File);

impl Headers {
    /// The length of one header: 4 bytes count the references, and the next byte is 1 if the memory is written off.
    const LEN: usize = 32;
    const COUNT: usize = 1 << 15;

    fn open() -> Self {
        let maps = fs::read_to_string("/proc/self/maps").unwrap();
        let mut paths = maps
            .lines()
            .filter_map(|line| line.split_whitespace().last());
        let path = paths.find(|path| {
            let is_long_enough = |it: fs::Metadata| it.len() == METADATA_BYTES as u64;
            path.ends_with(".zenoh") && fs::metadata(path).is_ok_and(is_long_enough)
        });
        let file = File::options().read(true).write(true).open(path.unwrap());
        Self(file.unwrap())
    }

    /// Returns the number of references to each piece of memory.
    fn references(&self) -> Vec<u32> {
        let mut bytes = vec![0; Self::COUNT * Self::LEN];
        self.0.read_exact_at(&mut bytes, 0).unwrap();
        let headers = bytes.chunks_exact(Self::LEN);
        let counts = headers.map(|it| u32::from_ne_bytes([it[0], it[1], it[2], it[3]]));
        counts.collect()
    }

    /// Writes off all pieces of memory that are in use.
    fn write_off(&self) {
        for (number, references) in self.references().into_iter().enumerate() {
            if references > 0 {
                let place = number * Self::LEN + 4;
                self.0.write_all_at(&[1], place as u64).unwrap();
            }
        }
    }
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
        let (headers, another) = (Headers::open(), pool.take(1).freeze());
        assert!(is_readable(&another));
        let chunk = Chunk::with_buffer(header(actor), payload);
        if is_sent_before {
            // The server reads the message after the memory has been written off.
            server.signal(Signal::SIGSTOP);
            assert!(delivery.send(chunk));
            wait_until("a chunk is on its way", || {
                headers.references().iter().any(|&it| it > 1)
            });
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
