//! Encodes TensorBoard's event files: protobuf's wire format for the few messages that are written, and the framing of records.
//! Written by hand, as these are five small messages: `prost` brings a compiler, `tfrecord` an async runtime, and `tensorboard-rs` has
//! not changed since 2021.
//!
//! Sources: `event.proto`, `summary.proto` and `record_writer.cc` of TensorFlow. Field numbers are theirs.

const FILE_VERSION: &str = "brain.Event:2";
/// Protobuf's wire types.
const VARINT: u8 = 0;
const FIXED64: u8 = 1;
const BYTES: u8 = 2;
const FIXED32: u8 = 5;

#[derive(Debug)]
pub(super) enum Value {
    Scalar(f32),
    /// The count of each of the numbers 0, 1, 2, ...
    Counts(Vec<u64>),
    Image {
        width: usize,
        height: usize,
        png: Vec<u8>,
    },
}

/// The time of an event: seconds since 1970, and the step over which it is drawn.
#[derive(Clone, Copy, Debug)]
pub(super) struct EventTime {
    pub(super) seconds: f64,
    pub(super) step: u64,
}

pub(super) fn version(at: EventTime) -> Vec<u8> {
    record(at, 3, FILE_VERSION.as_bytes())
}

/// A record that invalidates what was written before for this step or later.
pub(super) fn restart_record(at: EventTime) -> Vec<u8> {
    const START: u64 = 1;
    record(at, 7, &number(1, START))
}

pub(super) fn summary(at: EventTime, values: &[(String, Value)]) -> Vec<u8> {
    let field = |(name, value): &(String, Value)| {
        let value = match value {
            Value::Scalar(value) => fixed(2, FIXED32, &value.to_le_bytes()),
            Value::Counts(counts) => bytes(5, &histogram(counts)),
            Value::Image { width, height, png } => {
                const RGB: u64 = 3;
                let [height, width] =
                    [(1, height), (2, width)].map(|(n, it)| number(n, *it as u64));
                bytes(4, &[height, width, number(3, RGB), bytes(4, png)].concat())
            }
        };
        bytes(1, &[bytes(1, name.as_bytes()), value].concat())
    };
    let fields: Vec<_> = values.iter().flat_map(field).collect();
    record(at, 5, &fields)
}

/// A `HistogramProto` in which each number has a bucket, from half below it to half above. The minimum and the maximum are the ends of
/// the outer buckets in use, as TensorBoard draws nothing beyond them.
fn histogram(counts: &[u64]) -> Vec<u8> {
    let total = counts.iter().map(|&n| n as f64).sum::<f64>();
    let (mut sum, mut squares) = (0.0, 0.0);
    for (value, &n) in counts.iter().enumerate() {
        sum += value as f64 * n as f64;
        squares += (value * value) as f64 * n as f64;
    }
    let least = counts.iter().position(|&n| n > 0);
    let least = least.map_or(0.0, |value| value as f64 - 0.5);
    let most = counts.iter().rposition(|&n| n > 0);
    let most = most.map_or(0.0, |value| value as f64 + 0.5);
    let facts = [(1, least), (2, most), (3, total), (4, sum), (5, squares)];
    let facts = facts.map(|(field, value)| fixed(field, FIXED64, &f64::to_le_bytes(value)));
    // A first, empty bucket ends where the bucket of 0 begins.
    let limits = (0..=counts.len()).map(|value| value as f64 - 0.5);
    let numbers = std::iter::once(0.0).chain(counts.iter().map(|&n| n as f64));
    let buckets = [bytes(6, &packed(limits)), bytes(7, &packed(numbers))];
    [facts.concat(), buckets.concat()].concat()
}

fn packed(values: impl Iterator<Item = f64>) -> Vec<u8> {
    values.flat_map(f64::to_le_bytes).collect()
}

fn fixed(field: u8, kind: u8, value: &[u8]) -> Vec<u8> {
    [&[field << 3 | kind][..], value].concat()
}

fn number(field: u8, value: u64) -> Vec<u8> {
    fixed(field, VARINT, &varint(value))
}

fn bytes(field: u8, value: &[u8]) -> Vec<u8> {
    let length = varint(value.len() as u64);
    fixed(field, BYTES, &[&length[..], value].concat())
}

/// Seven bits per byte, the lowest first; all but the last byte have the eighth bit set.
fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value > 0x7f {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

/// The record of an event that has one field beside its time and step.
fn record(EventTime { seconds, step }: EventTime, field: u8, value: &[u8]) -> Vec<u8> {
    let seconds = fixed(1, FIXED64, &seconds.to_le_bytes());
    let event = [seconds, number(2, step), bytes(field, value)].concat();
    let length = (event.len() as u64).to_le_bytes();
    let [of_length, of_event] = [&length[..], &event].map(|it| masked(crc32c(it)).to_le_bytes());
    [&length[..], &of_length, &event, &of_event].concat()
}

/// Masks a checksum, as TensorFlow does because the data of a record may contain checksums.
const fn masked(crc: u32) -> u32 {
    crc.rotate_right(15).wrapping_add(0xa282_ead8)
}

/// CRC-32C (Castagnoli), bit by bit: fast enough for a kilobyte of records per second.
fn crc32c(data: &[u8]) -> u32 {
    const POLYNOMIAL: u32 = 0x82f6_3b78;
    let mut crc = u32::MAX;
    for &byte in data {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = crc >> 1 ^ if crc & 1 == 1 { POLYNOMIAL } else { 0 };
        }
    }
    !crc
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Source: RFC 3720, appendix B.4, and the usual check value.
    #[test]
    fn checksums_are_the_standard_s() {
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
    }

    #[test]
    fn a_record_is_framed_and_a_scalar_has_its_fields() {
        let at = EventTime {
            seconds: 1.5,
            step: 300,
        };
        let record = summary(at, &[("a/b".into(), Value::Scalar(0.25))]);
        let length = u64::from_le_bytes(record[..8].try_into().unwrap()) as usize;
        assert_eq!(record.len(), 8 + 4 + length + 4);
        let data = &record[12..12 + length];
        assert_eq!(record[8..12], masked(crc32c(&record[..8])).to_le_bytes());
        assert_eq!(record[12 + length..], masked(crc32c(data)).to_le_bytes());
        let mut wanted = vec![9];
        wanted.extend(1.5f64.to_le_bytes());
        wanted.extend([16, 0xac, 2]);
        // summary { value { tag: "a/b" simple_value: 0.25 } }
        wanted.extend([
            42, 12, 10, 10, 10, 3, b'a', b'/', b'b', 21, 0, 0, 0x80, 0x3e,
        ]);
        assert_eq!(data, wanted);
    }
}
