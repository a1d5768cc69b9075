//! Opens input files as plain bytes. It decodes gzip and UTF-16, so that parsers see plain text or binary data only.
//!
//! The first bytes of a file decide, never its name. Nothing is parsed here. A damaged archive is reported as a read
//! error.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Read};
use std::path::Path;

/// A byte of a Deflate stream expands to at most this many bytes, because a match has at most 258 bytes and takes at
/// least 2 bits.
const EXPANSION_MAX: u64 = 1032;

/// An opened input file.
pub struct Input {
    /// The decoded bytes.
    pub reader: Box<dyn BufRead>,
    /// Upper bound of the bytes that the reader gives. It limits the memory that a parser reserves on the word of a
    /// header.
    pub bytes: u64,
    /// True if the reader gives exactly `bytes` bytes. The exact size of an archive is not known.
    pub exact: bool,
}

/// How pipes and devices are treated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Streams {
    /// Only regular files are opened, because files named in a scene are read again when a run is resumed.
    Refused,
    /// A pipe is read to its end before parsing.
    Accepted,
}

impl Input {
    /// Opens a file.
    ///
    /// # Errors
    /// The path cannot be opened or read, or is not a file.
    pub fn open(path: &Path, streams: Streams) -> io::Result<Input> {
        let file = File::open(path)?;
        let metadata = file.metadata()?;
        if metadata.is_dir() || (!metadata.is_file() && streams == Streams::Refused) {
            return Err(io::Error::other("it is not a file"));
        }
        let mut reader = BufReader::with_capacity(1 << 20, file);
        if metadata.is_file() {
            return Input::decoded(reader, metadata.len());
        }
        let mut all = Vec::new();
        reader.read_to_end(&mut all)?;
        let bytes = all.len() as u64;
        Input::decoded(Cursor::new(all), bytes)
    }

    /// Wraps `reader`, which gives `bytes` bytes, and decodes its content.
    pub fn decoded(mut reader: impl BufRead + 'static, mut bytes: u64) -> io::Result<Input> {
        if first_bytes(&mut reader)?.starts_with(&[0x1f, 0x8b]) {
            bytes = bytes.saturating_mul(EXPANSION_MAX);
            let plain = BufReader::with_capacity(1 << 20, flate2::bufread::MultiGzDecoder::new(reader));
            return Ok(Input { exact: false, ..Input::plain(plain, bytes)? });
        }
        Input::plain(reader, bytes)
    }

    fn plain(mut reader: impl BufRead + 'static, bytes: u64) -> io::Result<Input> {
        let start = first_bytes(&mut reader)?;
        let word = match start[..] {
            [0xff, 0xfe, ..] => u16::from_le_bytes,
            [0xfe, 0xff, ..] => u16::from_be_bytes,
            _ => {
                let mark = if start.starts_with(&[0xef, 0xbb, 0xbf]) { 3 } else { 0 };
                reader.consume(mark);
                return Ok(Input { reader: Box::new(reader), bytes: bytes.saturating_sub(mark as u64), exact: true });
            }
        };
        let mut all = Vec::new();
        reader.read_to_end(&mut all)?;
        let words = all[2..].as_chunks::<2>().0.iter().map(|&pair| word(pair));
        let text: String = char::decode_utf16(words).map(|c| c.unwrap_or(char::REPLACEMENT_CHARACTER)).collect();
        let bytes = text.len() as u64;
        Ok(Input { reader: Box::new(Cursor::new(text.into_bytes())), bytes, exact: true })
    }
}

/// Up to three bytes, without consuming them. A reader that returns fewer bytes at once yields fewer.
fn first_bytes(reader: &mut impl BufRead) -> io::Result<Vec<u8>> {
    loop {
        match reader.fill_buf() {
            Ok(start) => return Ok(start[..start.len().min(3)].to_vec()),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn read(bytes: &[u8]) -> io::Result<String> {
        let mut text = String::new();
        let mut input = Input::decoded(Cursor::new(bytes.to_vec()), bytes.len() as u64)?;
        input.reader.read_to_string(&mut text)?;
        assert!(text.len() as u64 <= input.bytes);
        Ok(text)
    }

    fn zipped(bytes: &[u8]) -> Vec<u8> {
        let mut out = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        out.write_all(bytes).unwrap();
        out.finish().unwrap()
    }

    #[test]
    fn plain_marked_wide_and_zipped_text_read_alike() {
        let text = "v 1 2 3 # Größe\n";
        let wide = |word: fn(u16) -> [u8; 2]| -> Vec<u8> {
            std::iter::once(0xfeff).chain(text.encode_utf16()).flat_map(word).collect()
        };
        let forms =
            [text.into(), [b"\xef\xbb\xbf", text.as_bytes()].concat(), wide(u16::to_le_bytes), wide(u16::to_be_bytes)];
        for form in forms {
            assert_eq!(read(&form).unwrap(), text);
            assert_eq!(read(&zipped(&form)).unwrap(), text);
            // A concatenation of two archives is one file.
            let twice = [zipped(&form[..4]), zipped(&form[4..])].concat();
            assert_eq!(read(&twice).unwrap(), text);
        }
        for short in [&b""[..], b"v", b"\xff\xfe", b"\xff\xfe1"] {
            assert!(read(short).is_ok());
        }
    }

    #[test]
    fn a_damaged_archive_is_an_error() {
        let mut bytes = zipped(b"some text that is long enough to be damaged");
        assert!(read(&bytes[..bytes.len() - 9]).is_err() && read(b"\x1f\x8b").is_err());
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0xff;
        assert!(read(&bytes).is_err());
    }

    #[test]
    fn only_files_are_opened_unless_pipes_are_accepted() {
        let refused =
            |path: &str, streams| Input::open(Path::new(path), streams).map(|_| ()).map_err(|e| e.to_string());
        assert_eq!(refused("/", Streams::Accepted).unwrap_err(), "it is not a file");
        assert_eq!(refused("/dev/null", Streams::Refused).unwrap_err(), "it is not a file");
        assert_eq!(refused("/dev/null", Streams::Accepted), Ok(()));
    }
}
