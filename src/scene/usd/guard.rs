//! Looks at the counts in a binary USD file before the crate reads it. The crate reserves memory on the word of the
//! file, so a damaged count would end the process; everything else that is wrong is found by the crate.
//!
//! The layout is that of version 0.4 and later: sections at the end, values before them.

/// Bits of a value: it is a list; it has no place; it is compressed.
const ARRAY: u64 = 1 << 63;
const INLINED: u64 = 1 << 62;
const CODED: u64 = 1 << 61;
const PLACE: u64 = (1 << 48) - 1;
/// An LZ4 block is at most this much longer than its bytes.
const EXPANSION: u64 = 256;
/// Integers whose differences are alike take two bits, and as many of these bytes alike are compressed once more.
const INTEGERS_PER_BYTE: u64 = 4 * EXPANSION;
/// Values within values, such as samples.
const DEEPEST: usize = 4;

struct Crate<'a> {
    bytes: &'a [u8],
    version: u8,
}

const BINARY: &[u8] = b"PXR-USDC";
/// Begins a file in a package (`.usdz`, a zip archive).
const PACKED: &[u8] = b"PK\x03\x04";

/// True for the first bytes of a file that [`check`] has something to say of.
pub(super) fn is_checked(head: &[u8]) -> bool {
    head.starts_with(BINARY) || head.starts_with(PACKED)
}

/// Checks the file if it is a binary stage, or a package with binary stages in it. An error is half a sentence.
pub(super) fn check(bytes: &[u8]) -> Result<(), String> {
    if bytes.starts_with(PACKED) {
        return check_packed(bytes);
    }
    if !bytes.starts_with(BINARY) {
        return Ok(());
    }
    let file = Crate { bytes, version: bytes.get(9).copied().unwrap_or(0) };
    if file.version < 4 {
        return Err("is a binary stage of a version before 0.4, which is not read: save it anew".into());
    }
    file.sections()
}

/// Checks the files of a package, which lie in it one after the other as they are.
fn check_packed(mut bytes: &[u8]) -> Result<(), String> {
    /// Bytes before the name of a file.
    const HEAD: usize = 30;
    while bytes.starts_with(PACKED) {
        let cut_off = || "is cut off: a file in it has fewer bytes than it needs".to_owned();
        let head = bytes.first_chunk::<HEAD>().ok_or_else(cut_off)?;
        let word = |at: usize| usize::from(u16::from_le_bytes([head[at], head[at + 1]]));
        let size = u32::from_le_bytes([head[18], head[19], head[20], head[21]]) as usize;
        // Bit 3: sizes stand after the file.
        if word(8) != 0 || word(6) & 8 != 0 {
            return Err("is a package whose files are compressed, which USD does not allow".into());
        }
        let start = HEAD + word(26) + word(28);
        let end = start.saturating_add(size);
        check(bytes.get(start..end).ok_or_else(cut_off)?)?;
        bytes = &bytes[end..];
    }
    Ok(())
}

impl<'a> Crate<'a> {
    fn word(&self, at: u64) -> Result<u64, String> {
        let at = usize::try_from(at).ok();
        let bytes = at.and_then(|at| self.bytes.get(at..)?.first_chunk::<8>());
        bytes
            .map(|bytes| u64::from_le_bytes(*bytes))
            .ok_or_else(|| "is cut off: it has fewer bytes than it needs".into())
    }

    /// Bytes from a place to the end.
    fn after(&self, at: u64) -> u64 {
        (self.bytes.len() as u64).saturating_sub(at)
    }

    fn fits(&self, count: u64, most: u64) -> Result<(), String> {
        if count <= most { Ok(()) } else { Err(format!("is damaged: it counts {count} where {most} fit at most")) }
    }

    fn sections(&self) -> Result<(), String> {
        let table = self.word(16)?;
        let count = self.word(table)?;
        self.fits(count, self.after(table) / 32)?;
        for section in 0..count {
            let at = table + 8 + 32 * section;
            let (start, size) = (self.word(at + 16)?, self.word(at + 24)?);
            self.fits(start, self.bytes.len() as u64)?;
            self.fits(size, self.after(start))?;
            let name = &self.bytes[at as usize..at as usize + 16];
            let name = name.split(|&byte| byte == 0).next().unwrap_or_default();
            let count = self.word(start)?;
            match name {
                b"TOKENS" => {
                    self.fits(count, size.saturating_mul(EXPANSION))?;
                    self.fits(self.word(start + 8)?, size.saturating_mul(EXPANSION))?;
                    self.fits(self.word(start + 16)?, size)?;
                }
                b"STRINGS" => self.fits(count, size / 4)?,
                b"FIELDS" => self.fields(start, size)?,
                b"FIELDSETS" => {
                    self.fits(count, size.saturating_mul(INTEGERS_PER_BYTE))?;
                    self.blocks(start + 8, 1)?;
                }
                b"PATHS" => {
                    self.fits(count, size.saturating_mul(INTEGERS_PER_BYTE))?;
                    self.fits(self.word(start + 8)?, count)?;
                    self.blocks(start + 16, 3)?;
                }
                b"SPECS" => {
                    self.fits(count, size.saturating_mul(INTEGERS_PER_BYTE))?;
                    self.blocks(start + 8, 3)?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Blocks that follow each other, each with its length before it. Returns the place after them.
    fn blocks(&self, mut at: u64, count: usize) -> Result<u64, String> {
        for _ in 0..count {
            let length = self.word(at)?;
            self.fits(length, self.after(at + 8))?;
            at += 8 + length;
        }
        Ok(at)
    }

    fn fields(&self, start: u64, size: u64) -> Result<(), String> {
        let count = self.word(start)?;
        self.fits(count, size.saturating_mul(EXPANSION) / 8)?;
        let at = self.blocks(start + 8, 1)?;
        let end = self.blocks(at, 1)?;
        let block = &self.bytes[at as usize + 8..end as usize];
        let values = unpacked(block, 8 * count as usize).ok_or("is damaged: its fields cannot be unpacked")?;
        values.as_chunks::<8>().0.iter().try_for_each(|value| self.value(u64::from_le_bytes(*value), 0))
    }

    fn value(&self, value: u64, depth: usize) -> Result<(), String> {
        let (kind, at) = (value >> 48 & 0xff, value & PLACE);
        if value & INLINED != 0 || at == 0 {
            return Ok(());
        }
        if value & ARRAY != 0 {
            // Older files have the number of dimensions first, and shorter counts.
            let at = if self.version < 5 { at + 4 } else { at };
            let (count, first) = match self.version < 7 {
                true => (self.word(at)? & u64::from(u32::MAX), at + 4),
                false => (self.word(at)?, at + 8),
            };
            if value & CODED != 0 {
                // A table of values may stand before their numbers.
                let table = self.word(first.saturating_add(1)).unwrap_or(0) & u64::from(u32::MAX);
                let is_real = matches!(kind, 7..=9);
                let has_table = is_real && self.bytes.get(first as usize) == Some(&b't');
                self.fits(if has_table { table } else { 0 }, self.after(first) / 4)?;
                let block = match has_table {
                    true => first.saturating_add(5).saturating_add(table.saturating_mul(width(kind))),
                    false => first + u64::from(is_real),
                };
                let length = if count < 4 { 0 } else { self.word(block)? };
                self.fits(length, self.after(block))?;
                return self.fits(count, length.max(64).saturating_mul(INTEGERS_PER_BYTE));
            }
            return self.fits(count, self.after(first) / width(kind));
        }
        match kind {
            // Lists that begin with their length: names, paths, numbers, layers, texts, names of variants.
            40 | 41 | 45 | 48 | 49 | 50 | 58 => self.fits(self.word(at)?, self.after(at) / 4),
            // Values by name.
            31 => self.fits(self.word(at)?, self.after(at) / 12),
            32..=39 | 55 => self.list_edits(at, kind),
            46 if depth < DEEPEST => self.samples(at, depth),
            _ => Ok(()),
        }
    }

    /// Lists of what to add, delete and so on: a byte says which there are.
    fn list_edits(&self, at: u64, kind: u64) -> Result<(), String> {
        let which = self.word(at)? as u8;
        let mut at = at + 1;
        for _ in 0..(which & !1).count_ones() {
            let count = self.word(at)?;
            self.fits(count, self.after(at) / 4)?;
            at += 8 + count * if matches!(kind, 37 | 39) { 8 } else { 4 };
            // The length of a reference is not fixed; what follows is not looked at.
            if matches!(kind, 35 | 55) {
                break;
            }
        }
        Ok(())
    }

    /// Times, then values; each stands a given way on.
    fn samples(&self, at: u64, depth: usize) -> Result<(), String> {
        let at = at.saturating_add(self.word(at)?);
        self.value(self.word(at)?, depth + 1)?;
        let at = at.saturating_add(8);
        let at = at.saturating_add(self.word(at)?);
        let count = self.word(at)?;
        self.fits(count, self.after(at) / 8)?;
        (0..count).try_for_each(|i| self.value(self.word(at + 8 + 8 * i)?, depth + 1))
    }
}

/// Fewest bytes of a value in a list.
fn width(kind: u64) -> u64 {
    match kind {
        1 | 2 => 1,
        7 => 2,
        5 | 6 | 9 | 20 | 22 => 8,
        13 => 32,
        14 => 72,
        15 => 128,
        16 | 27 => 32,
        17 | 28 | 30 => 16,
        18 | 29 => 8,
        19 => 16,
        23 => 24,
        24 | 26 => 12,
        25 => 6,
        _ => 4,
    }
}

/// The bytes of LZ4 blocks behind a mark for their number; none if they are not that many.
fn unpacked(block: &[u8], bytes: usize) -> Option<Vec<u8>> {
    let (&blocks, mut rest) = block.split_first()?;
    let mut out = Vec::with_capacity(bytes);
    if blocks == 0 {
        unpack(rest, bytes, &mut out)?;
    }
    for _ in 0..blocks {
        let (length, more) = rest.split_first_chunk::<4>()?;
        let (own, more) = more.split_at_checked(usize::try_from(i32::from_le_bytes(*length)).ok()?)?;
        unpack(own, bytes, &mut out)?;
        rest = more;
    }
    (out.len() == bytes).then_some(out)
}

/// Appends the bytes of an LZ4 block, at most `most` in all.
fn unpack(mut block: &[u8], most: usize, out: &mut Vec<u8>) -> Option<()> {
    fn length(nibble: u8, block: &mut &[u8]) -> Option<usize> {
        let mut length = usize::from(nibble);
        let mut last = if nibble == 15 { 255 } else { 0 };
        while last == 255 {
            let (&byte, rest) = block.split_first()?;
            (last, *block) = (byte, rest);
            length += usize::from(byte);
        }
        Some(length)
    }
    loop {
        let (&token, rest) = block.split_first()?;
        block = rest;
        let (literals, rest) = {
            let count = length(token >> 4, &mut block)?;
            block.split_at_checked(count)?
        };
        out.extend_from_slice(literals);
        block = rest;
        if out.len() > most {
            return None;
        }
        if block.is_empty() {
            return Some(());
        }
        let (offset, rest) = block.split_first_chunk::<2>()?;
        block = rest;
        let count = length(token & 15, &mut block)? + 4;
        let offset = usize::from(u16::from_le_bytes(*offset));
        let start = out.len().checked_sub(offset).filter(|_| offset > 0)?;
        if count > most - out.len().min(most) {
            return None;
        }
        (start..start + count).for_each(|i| out.push(out[i]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_unpacked() {
        // Three literals, a match of 8 that repeats them, and a last literal.
        let block = [0, 3 << 4 | 4, b'a', b'b', b'c', 3, 0, 1 << 4, b'z'];
        assert_eq!(unpacked(&block, 12).as_deref(), Some(&b"abcabcabcabz"[..]));
        assert_eq!(unpacked(&block, 11), None);
        assert_eq!(unpacked(&block[..6], 12), None);
        assert_eq!(unpacked(&[0, 0xf0, 255, 30], 300), None);
    }

    #[test]
    fn counts_that_do_not_fit_are_refused() {
        let mut bytes = b"PXR-USDC\0\x08\0\0\0\0\0\0".to_vec();
        bytes.extend(u64::to_le_bytes(24));
        bytes.extend(u64::to_le_bytes(u64::MAX));
        assert!(check(&bytes).unwrap_err().contains("counts 18446744073709551615"));
        assert!(check(&bytes[..20]).unwrap_err().contains("cut off"));
        assert!(check(b"PXR-USDC\0\x03\0").unwrap_err().contains("version before 0.4"));
        assert_eq!(check(b"#usda 1.0"), Ok(()));
    }
}
