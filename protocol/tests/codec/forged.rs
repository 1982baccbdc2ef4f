//! Messages that no process of this project sends: right checksums over whatever header and payload.
//! What becomes of them is tested in `damaged`.

use driml_protocol::PROTOCOL_VERSION;

use crate::samples::SPEC;

/// A message with a right checksum and whatever else.
pub(crate) fn forge(
    version: u16,
    kind: u16,
    lengths: (u32, u64),
    header: &[u8],
    payload: &[u8],
) -> Vec<u8> {
    let mut bytes = b"DRML".to_vec();
    bytes.extend(version.to_le_bytes());
    bytes.extend(kind.to_le_bytes());
    bytes.extend(SPEC.to_le_bytes());
    bytes.extend(lengths.0.to_le_bytes());
    bytes.extend(lengths.1.to_le_bytes());
    let mut hasher = crc32fast::Hasher::new();
    [&bytes, header, payload]
        .iter()
        .for_each(|part| hasher.update(part));
    bytes.extend(hasher.finalize().to_le_bytes());
    bytes.extend_from_slice(header);
    bytes.extend_from_slice(payload);
    bytes
}

pub(crate) fn forge_whole(kind: u16, header: &[u8], payload: &[u8]) -> Vec<u8> {
    forge(
        PROTOCOL_VERSION,
        kind,
        (header.len() as u32, payload.len() as u64),
        header,
        payload,
    )
}
