//! The container of Alembic files: groups of groups and data, and in them archives, objects and properties, as
//! AbcCoreOgawa of Alembic 1.8 lays them out. Every offset is checked, because files may be cut off or damaged.
//!
//! Data is a length (u64) and bytes. A group is a count (u64) and that many children (u64): offsets, whose highest bit
//! is set for data. All numbers are little-endian.

/// Offset without the bit of data.
const OFFSET: u64 = !DATA;
/// The bit that data has and a group has not.
const DATA: u64 = 1 << 63;
/// Bytes before the values of a sample: a key of its content.
const KEY_BYTES: usize = 16;
/// Metadata that stands in place instead of in the table of the archive.
const IN_PLACE: usize = 0xff;

/// Types of numbers in properties.
pub(super) const U8: u8 = 1;
pub(super) const BOOL: u8 = 0;
pub(super) const I32: u8 = 6;
pub(super) const F32: u8 = 10;
pub(super) const F64: u8 = 11;

/// A file and what all of its objects refer to.
pub(super) struct Archive {
    bytes: Vec<u8>,
    /// Time of the samples of every sampling.
    samplings: Vec<Sampling>,
    /// Metadata that properties and objects name by number.
    metadata: Vec<String>,
    root: Group,
}

/// When the samples of a property are.
#[derive(Clone, Debug)]
struct Sampling {
    /// Seconds from a cycle to the next; unbounded if there is only one.
    cycle_s: f64,
    /// Times within a cycle, seconds.
    times_s: Vec<f64>,
}

/// Children of a group.
#[derive(Clone, Debug)]
struct Group(Vec<u64>);

/// A node of the tree: what is said of it, its properties and its children.
pub(super) struct Object {
    pub name: String,
    /// `key=value;..`
    pub metadata: String,
    group: Group,
}

/// A list of properties.
pub(super) struct Compound(Vec<(Header, Group)>);

/// A property with samples.
pub(super) struct Property<'a> {
    archive: &'a Archive,
    header: &'a Header,
    group: &'a Group,
}

#[derive(Clone, Debug)]
struct Header {
    name: String,
    kind: Kind,
    number: u8,
    /// Numbers per value.
    extent: usize,
    samples: usize,
    /// The first sample that differs from the one before, and the last that does.
    changed: [usize; 2],
    sampling: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Compound,
    Scalar,
    Array,
}

/// Bytes of a header that are read one after the other.
struct Words<'a>(&'a [u8]);

impl<'a> Words<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.0.split_at_checked(count).ok_or("is damaged: a header is too short")?;
        self.0 = rest;
        Ok(taken)
    }

    /// An unsigned number of 1 to 8 bytes.
    fn number(&mut self, bytes: usize) -> Result<u64, String> {
        let mut word = [0; 8];
        word[..bytes].copy_from_slice(self.take(bytes)?);
        Ok(u64::from_le_bytes(word))
    }

    fn real(&mut self) -> Result<f64, String> {
        self.number(8).map(f64::from_bits)
    }

    fn text(&mut self, bytes: usize) -> Result<String, String> {
        self.take(bytes).map(|text| String::from_utf8_lossy(text).into_owned())
    }
}

impl Archive {
    /// An error is half a sentence.
    pub(super) fn new(bytes: Vec<u8>) -> Result<Archive, String> {
        if bytes.starts_with(b"\x89HDF") {
            return Err(
                "is an Alembic file of the old HDF5 kind, which is not read; save it as Ogawa, Alembic's kind \
                        since 2013"
                    .into(),
            );
        }
        if !bytes.starts_with(b"Ogawa") {
            return Err("is not an Alembic file: it does not begin with Ogawa".into());
        }
        let mut archive = Archive { bytes, samplings: Vec::new(), metadata: vec![String::new()], root: Group(vec![]) };
        let mut head = Words(&archive.bytes[5..]);
        let finished = head.number(1)?;
        head.number(2)?;
        let root = head.number(8)?;
        if finished != 0xff {
            return Err("is cut off: its writer did not finish it".into());
        }
        archive.root = archive.group(root)?;
        if archive.root.0.len() < 6 {
            return Err("is damaged: its archive has too few parts".into());
        }
        let (times, names) = (archive.data(archive.root.0[4])?, archive.data(archive.root.0[5])?);
        let mut words = Words(times);
        let mut samplings = Vec::new();
        while !words.0.is_empty() {
            words.number(4)?;
            let cycle_s = words.real()?;
            let count = words.number(4)? as usize;
            let times_s = words.take(count.saturating_mul(8))?.as_chunks::<8>().0;
            let times_s: Vec<f64> = times_s.iter().map(|time| f64::from_le_bytes(*time)).collect();
            if times_s.is_empty() {
                return Err("is damaged: it has a time sampling without times".into());
            }
            samplings.push(Sampling { cycle_s, times_s });
        }
        let mut words = Words(names);
        let mut metadata = vec![String::new()];
        while !words.0.is_empty() {
            let length = words.number(1)? as usize;
            metadata.push(words.text(length)?);
        }
        (archive.samplings, archive.metadata) = (samplings, metadata);
        Ok(archive)
    }

    /// The object that holds all others.
    pub(super) fn top(&self) -> Result<Object, String> {
        Ok(Object { name: String::new(), metadata: String::new(), group: self.group(self.root.0[2])? })
    }

    fn group(&self, child: u64) -> Result<Group, String> {
        if child & DATA != 0 {
            return Err("is damaged: data stands where a group must be".into());
        }
        if child == 0 {
            return Ok(Group(Vec::new()));
        }
        let cut = || format!("is cut off: it has {} bytes, too few for what it refers to", self.bytes.len());
        let start = usize::try_from(child).ok().filter(|&start| start < self.bytes.len()).ok_or_else(cut)?;
        let mut words = Words(&self.bytes[start..]);
        let count = words.number(8).map_err(|_| cut())? as usize;
        let children = words.take(count.saturating_mul(8)).map_err(|_| cut())?;
        Ok(Group(children.as_chunks::<8>().0.iter().map(|child| u64::from_le_bytes(*child)).collect()))
    }

    fn data(&self, child: u64) -> Result<&[u8], String> {
        if child & DATA == 0 {
            return Err("is damaged: a group stands where data must be".into());
        }
        if child & OFFSET == 0 {
            return Ok(&[]);
        }
        let cut = || format!("is cut off: it has {} bytes, too few for what it refers to", self.bytes.len());
        let start = usize::try_from(child & OFFSET).ok().filter(|&start| start < self.bytes.len()).ok_or_else(cut)?;
        let mut words = Words(&self.bytes[start..]);
        let length = words.number(8).map_err(|_| cut())?;
        words.take(usize::try_from(length).map_err(|_| cut())?).map_err(|_| cut())
    }

    fn metadata_of(&self, number: usize, words: &mut Words, length_bytes: usize) -> Result<String, String> {
        if number != IN_PLACE {
            let found = self.metadata.get(number).cloned();
            return found.ok_or_else(|| "is damaged: a header names metadata that is not there".into());
        }
        let length = words.number(length_bytes)? as usize;
        words.text(length)
    }
}

impl Object {
    /// The objects below, in the order of the file.
    pub(super) fn children(&self, archive: &Archive) -> Result<Vec<Object>, String> {
        /// What follows the headers: keys of properties and of children.
        const KEYS: usize = 2 * KEY_BYTES;
        let Some(&last) = self.group.0.last() else { return Ok(Vec::new()) };
        if last & DATA == 0 {
            return Ok(Vec::new());
        }
        let headers = archive.data(last)?;
        let mut words = Words(&headers[..headers.len().saturating_sub(KEYS)]);
        let mut children = Vec::new();
        while !words.0.is_empty() {
            let length = words.number(4)? as usize;
            let name = words.text(length)?;
            let number = words.number(1)? as usize;
            let metadata = archive.metadata_of(number, &mut words, 4)?;
            // The first child of the group holds the properties.
            let group = self.group.0.get(1 + children.len()).copied();
            let group = archive.group(group.ok_or("is damaged: it names more objects than it has")?)?;
            children.push(Object { name, metadata, group });
        }
        Ok(children)
    }

    /// The properties of the object itself.
    pub(super) fn properties(&self, archive: &Archive) -> Result<Compound, String> {
        match self.group.0.first() {
            Some(&first) if first & DATA == 0 => Compound::new(archive, &archive.group(first)?),
            _ => Ok(Compound(Vec::new())),
        }
    }
}

impl Compound {
    fn new(archive: &Archive, group: &Group) -> Result<Compound, String> {
        let Some((&last, groups)) = group.0.split_last() else { return Ok(Compound(Vec::new())) };
        if last & DATA == 0 {
            return Ok(Compound(Vec::new()));
        }
        let mut words = Words(archive.data(last)?);
        let mut all = Vec::new();
        while !words.0.is_empty() {
            let header = Header::read(archive, &mut words)?;
            let group = groups.get(all.len()).ok_or("is damaged: it names more properties than it has")?;
            all.push((header, archive.group(*group)?));
        }
        Ok(Compound(all))
    }

    /// The list with this name, if there is one.
    pub(super) fn compound(&self, archive: &Archive, name: &str) -> Result<Option<Compound>, String> {
        let found = self.0.iter().find(|(header, _)| header.name == name && header.kind == Kind::Compound);
        found.map(|(_, group)| Compound::new(archive, group)).transpose()
    }

    /// The property with this name, if there is one.
    pub(super) fn property<'a>(&'a self, archive: &'a Archive, name: &str) -> Option<Property<'a>> {
        let found = self.0.iter().find(|(header, _)| header.name == name && header.kind != Kind::Compound);
        found.map(|(header, group)| Property { archive, header, group })
    }
}

impl Header {
    fn read(archive: &Archive, words: &mut Words) -> Result<Header, String> {
        let info = words.number(4)? as usize;
        let kind = match info & 3 {
            0 => Kind::Compound,
            1 => Kind::Scalar,
            _ => Kind::Array,
        };
        // Lengths and counts take 1, 2 or 4 bytes.
        let bytes = match info >> 2 & 3 {
            0 => 1,
            1 => 2,
            2 => 4,
            _ => return Err("is damaged: a header has counts of unknown length".into()),
        };
        let mut header = Header {
            name: String::new(),
            kind,
            number: (info >> 4 & 15) as u8,
            extent: info >> 12 & 0xff,
            samples: 0,
            changed: [0, 0],
            sampling: 0,
        };
        if kind != Kind::Compound {
            header.samples = words.number(bytes)? as usize;
            if info & 0x200 != 0 {
                header.changed = [words.number(bytes)? as usize, words.number(bytes)? as usize];
            } else if info & 0x800 == 0 {
                header.changed = [1, header.samples.saturating_sub(1)];
            }
            if info & 0x100 != 0 {
                header.sampling = words.number(bytes)? as usize;
            }
            if header.sampling >= archive.samplings.len() || header.changed[0] > header.changed[1].max(1) {
                return Err("is damaged: a property has samples at unknown times".into());
            }
        }
        let length = words.number(bytes)? as usize;
        header.name = words.text(length)?;
        archive.metadata_of(info >> 20 & 0xff, words, bytes)?;
        Ok(header)
    }
}

impl<'a> Property<'a> {
    /// Number of samples.
    pub(super) fn samples(&self) -> usize {
        self.header.samples
    }

    /// Numbers per value.
    pub(super) fn extent(&self) -> usize {
        self.header.extent
    }

    /// True if all samples are stored as one.
    pub(super) fn is_constant(&self) -> bool {
        (1..self.samples()).all(|sample| self.place(sample) == self.place(0))
    }

    /// Times of the samples, seconds.
    pub(super) fn times_s(&self) -> Vec<f64> {
        let Sampling { cycle_s, times_s } = &self.archive.samplings[self.header.sampling];
        let time = |sample: usize| times_s[sample % times_s.len()] + (sample / times_s.len()) as f64 * cycle_s;
        (0..self.samples()).map(time).collect()
    }

    /// The bytes of a sample, whose numbers must be of this type.
    pub(super) fn bytes(&self, sample: usize, number: u8) -> Result<&'a [u8], String> {
        let name = &self.header.name;
        if self.header.number != number {
            return Err(format!("has a property `{name}` with numbers of another type than Alembic prescribes"));
        }
        let per_sample = if self.header.kind == Kind::Array { 2 } else { 1 };
        let child = self.group.0.get(per_sample * self.place(sample));
        let child = child.ok_or_else(|| format!("is damaged: sample {sample} of `{name}` is not there"))?;
        let bytes = self.archive.data(*child)?;
        if bytes.is_empty() {
            Ok(bytes)
        } else {
            bytes.get(KEY_BYTES..).ok_or("is damaged: a sample is too short".into())
        }
    }

    /// Where a sample is stored: those before the first change are one, those after the last as well.
    fn place(&self, sample: usize) -> usize {
        let [first, last] = self.header.changed;
        if sample < first || self.header.changed == [0, 0] { 0 } else { sample.min(last) + 1 - first }
    }
}
