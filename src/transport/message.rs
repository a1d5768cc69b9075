//! Messages between coordinator and workers as bytes: a small serde header, then bulk arrays that are not serialized.
//! Arrays are aligned so that they can be read in place. The meaning of the messages lies in `protocol`.
//!
//! Layout (little-endian): magic, version, header length, number of arrays, their lengths, header, arrays; header and
//! arrays each begin at a multiple of 16 bytes.

use std::borrow::Cow;

use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

/// First bytes of every message.
const MAGIC: [u8; 4] = *b"LTMS";
/// Changes with the layout or the meaning of a header.
const VERSION: u32 = 1;
/// Magic, version, header length, number of arrays.
const FIXED: usize = 16;
/// Alignment of every part, bytes.
const ALIGNMENT: usize = 16;
/// Longest header, bytes. Bulk data belong into arrays.
const HEADER_MAX: usize = 16 << 20;
const ARRAYS_MAX: usize = 4096;

/// Error of decoding or encoding a message.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum MessageError {
    /// The bytes do not begin like a message.
    #[error("not a message of this program (wrong first bytes)")]
    Foreign,
    /// Another version of this program made it.
    #[error("a message of format version {got}, expected {VERSION}: coordinator and workers must be the same build")]
    Version { got: u32 },
    /// The lengths do not fit the bytes.
    #[error("a cut or damaged message: {what}")]
    Damaged { what: &'static str },
    /// The header is not of the expected type.
    #[error("the message's header cannot be read: {0}")]
    Header(#[from] bincode::error::DecodeError),
    /// The header cannot be serialized.
    #[error("the message's header cannot be written: {0}")]
    Encode(#[from] bincode::error::EncodeError),
    /// It exceeds the bounds of the format.
    #[error("{what} is {got}, at most {limit} is possible")]
    TooLarge { what: &'static str, got: usize, limit: usize },
    /// The length of an array is not a multiple of the length of an item.
    #[error("an array of {bytes} bytes does not hold items of {item} bytes")]
    Items { bytes: usize, item: usize },
}

fn configuration() -> impl bincode::config::Config {
    bincode::config::standard().with_limit::<HEADER_MAX>()
}

fn check(what: &'static str, got: usize, limit: usize) -> Result<(), MessageError> {
    if got > limit { Err(MessageError::TooLarge { what, got, limit }) } else { Ok(()) }
}

/// A message of `header` and `arrays`.
///
/// # Errors
/// The header cannot be serialized or is longer than 16 MiB, or there are more than 4096 arrays.
pub fn encode<M: Serialize>(header: &M, arrays: &[&[u8]]) -> Result<Vec<u8>, MessageError> {
    let header = bincode::serde::encode_to_vec(header, configuration())?;
    check("the length of a message's header", header.len(), HEADER_MAX)?;
    check("the number of a message's arrays", arrays.len(), ARRAYS_MAX)?;
    let padded = |len: usize| len.next_multiple_of(ALIGNMENT);
    let length: usize = arrays.iter().map(|array| padded(array.len())).sum();
    let mut bytes = Vec::with_capacity(padded(FIXED + 8 * arrays.len()) + padded(header.len()) + length);
    bytes.extend_from_slice(&MAGIC);
    bytes.extend_from_slice(&VERSION.to_le_bytes());
    bytes.extend_from_slice(&(header.len() as u32).to_le_bytes());
    bytes.extend_from_slice(&(arrays.len() as u32).to_le_bytes());
    for array in arrays {
        bytes.extend_from_slice(&(array.len() as u64).to_le_bytes());
    }
    for part in std::iter::once(header.as_slice()).chain(arrays.iter().copied()) {
        bytes.resize(padded(bytes.len()), 0);
        bytes.extend_from_slice(part);
    }
    bytes.resize(padded(bytes.len()), 0);
    Ok(bytes)
}

/// The header and the arrays (in place) of a message made by [`encode`].
///
/// # Errors
/// The bytes are not such a message of this version with a header of type `M`; never panics.
pub fn decode<M: DeserializeOwned>(bytes: &[u8]) -> Result<(M, Vec<&[u8]>), MessageError> {
    let cut = MessageError::Damaged { what: "it is shorter than its lengths say" };
    let fixed = bytes.get(..FIXED).ok_or(MessageError::Foreign)?;
    let word = |at: usize| u32::from_le_bytes([fixed[at], fixed[at + 1], fixed[at + 2], fixed[at + 3]]);
    if fixed[..4] != MAGIC {
        return Err(MessageError::Foreign);
    }
    if word(4) != VERSION {
        return Err(MessageError::Version { got: word(4) });
    }
    let (header_len, arrays_len) = (word(8) as usize, word(12) as usize);
    check("the length of a message's header", header_len, HEADER_MAX)?;
    check("the number of a message's arrays", arrays_len, ARRAYS_MAX)?;
    let Some(lengths) = bytes.get(FIXED..FIXED + 8 * arrays_len) else { return Err(cut) };
    let mut position = FIXED + lengths.len();
    let mut part = |len: usize| {
        let start = position.checked_next_multiple_of(ALIGNMENT)?;
        position = start.checked_add(len)?;
        bytes.get(start..position)
    };
    let Some(header) = part(header_len) else { return Err(cut) };
    let mut arrays = Vec::with_capacity(arrays_len);
    let (lengths, _) = lengths.as_chunks::<8>();
    for length in lengths {
        let Ok(length) = usize::try_from(u64::from_le_bytes(*length)) else { return Err(cut) };
        let Some(array) = part(length) else { return Err(cut) };
        arrays.push(array);
    }
    if position.checked_next_multiple_of(ALIGNMENT) != Some(bytes.len()) {
        return Err(MessageError::Damaged { what: "its length is not what its parts add up to" });
    }
    let (header, used) = bincode::serde::decode_from_slice(header, configuration())?;
    if used != header_len {
        return Err(MessageError::Damaged { what: "its header holds more than was expected" });
    }
    Ok((header, arrays))
}

/// The items of an array of a message: in place if the bytes are aligned, copied otherwise.
pub fn items_of<T: bytemuck::AnyBitPattern + bytemuck::NoUninit>(bytes: &[u8]) -> Result<Cow<'_, [T]>, MessageError> {
    match bytemuck::try_cast_slice(bytes) {
        Ok(items) => Ok(Cow::Borrowed(items)),
        Err(_) if size_of::<T>() > 0 && bytes.len().is_multiple_of(size_of::<T>()) => {
            Ok(Cow::Owned(bytemuck::pod_collect_to_vec(bytes)))
        }
        Err(_) => Err(MessageError::Items { bytes: bytes.len(), item: size_of::<T>() }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    type Header = (String, Vec<u32>, Option<f64>);

    #[test]
    fn arrays_are_aligned_and_come_back() {
        let floats = [1.5f32, -2.0, 3.25];
        let long: Vec<u64> = (0..1000).collect();
        let header: Header = ("configure".into(), vec![1, 2, 3], Some(0.5));
        let bytes = encode(&header, &[bytemuck::bytes_of(&floats), &[], bytemuck::cast_slice(&long), b"odd"]).unwrap();
        assert_eq!(bytes.len() % ALIGNMENT, 0);
        let (back, arrays) = decode::<Header>(&bytes).unwrap();
        assert_eq!(back, header);
        let starts: Vec<usize> = arrays.iter().map(|array| array.as_ptr() as usize - bytes.as_ptr() as usize).collect();
        assert!(starts.iter().all(|start| start % ALIGNMENT == 0));
        assert_eq!(*items_of::<f32>(arrays[0]).unwrap(), floats);
        assert!(arrays[1].is_empty());
        assert_eq!(*items_of::<u64>(arrays[2]).unwrap(), long);
        assert_eq!(arrays[3], b"odd");
        assert!(matches!(items_of::<u32>(arrays[3]), Err(MessageError::Items { bytes: 3, item: 4 })));
        // One byte off alignment: copied, not read in place.
        let shifted: Vec<u8> = std::iter::once(0).chain(arrays[2].iter().copied()).collect();
        assert_eq!(*items_of::<u64>(&shifted[1..]).unwrap(), long);
    }

    #[test]
    fn refusals_say_why() {
        let bytes = encode(&7u32, &[b"data"]).unwrap();
        assert!(matches!(decode::<u32>(b"short"), Err(MessageError::Foreign)));
        let mut other = bytes.clone();
        other[0] = b'X';
        assert!(matches!(decode::<u32>(&other), Err(MessageError::Foreign)));
        let mut newer = bytes.clone();
        newer[4] = 9;
        assert!(matches!(decode::<u32>(&newer), Err(MessageError::Version { got: 9 })));
        for len in 16..bytes.len() {
            assert!(decode::<u32>(&bytes[..len]).is_err(), "cut to {len} bytes");
        }
        let longer = [bytes.clone(), vec![0; 16]].concat();
        assert!(matches!(decode::<u32>(&longer), Err(MessageError::Damaged { .. })));
        assert!(decode::<String>(&bytes).is_err());
        assert!(matches!(decode::<()>(&bytes), Err(MessageError::Damaged { .. })));
        let mut huge = bytes.clone();
        huge[16..24].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(matches!(decode::<u32>(&huge), Err(MessageError::Damaged { .. })));
        let mut greedy = bytes;
        greedy[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(matches!(decode::<u32>(&greedy), Err(MessageError::TooLarge { .. })));
        let too_many = vec![&b""[..]; ARRAYS_MAX + 1];
        assert!(matches!(encode(&0u8, &too_many), Err(MessageError::TooLarge { got: 4097, .. })));
    }

    proptest! {
        #[test]
        fn round_trip(text in ".*", numbers: Vec<u32>, value: Option<f64>, arrays: Vec<Vec<u8>>) {
            let header = (text, numbers, value.filter(|v| !v.is_nan()));
            let views: Vec<&[u8]> = arrays.iter().map(Vec::as_slice).collect();
            let bytes = encode(&header, &views).unwrap();
            let (back, seen) = decode::<Header>(&bytes).unwrap();
            prop_assert_eq!(back, header);
            prop_assert_eq!(seen, views);
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes: Vec<u8>) {
            prop_assert!(decode::<Header>(&bytes).is_err() || bytes.starts_with(&MAGIC));
        }

        #[test]
        fn damaged_messages_never_panic(numbers: Vec<u32>, array: Vec<u8>, at: usize, value: u8, cut: usize) {
            let header: Header = ("x".into(), numbers, None);
            let mut bytes = encode(&header, &[&array]).unwrap();
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(bytes.len() - cut % 20);
            // Every decoded array lies within the message.
            if let Ok((_, arrays)) = decode::<Header>(&bytes) {
                prop_assert!(arrays.iter().map(|array| array.len()).sum::<usize>() <= bytes.len());
            }
        }
    }
}
