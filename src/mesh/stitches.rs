//! `stitch` and `seam` lines of OBJ files, as the garments of Codim-IPC have them [Li et al. 2021]: `stitch i a b t`
//! sews vertex i to the point (1 - t) x_a + t x_b of an edge, indices from 0; `seam n`: the next n stitches are one
//! seam.
//!
//! A seam becomes two sides: its vertices i, and the vertices of the edges that they are sewn to, from the first to the
//! last. Which of them meet follows from the lengths along both sides.

use super::FileSeam;
use super::words::numbers;

/// A stitch: vertex, edge and the share of the edge.
#[derive(Clone, Copy)]
struct Stitch {
    vertex: u32,
    edge: [u32; 2],
    share: f64,
}

/// The lines so far.
#[derive(Default)]
pub(super) struct Stitches {
    stitches: Vec<Stitch>,
    /// First stitch and length of every seam.
    seams: Vec<(usize, usize)>,
}

impl Stitches {
    pub(super) fn stitch<'a>(&mut self, mut words: impl Iterator<Item = &'a [u8]>) -> Result<(), String> {
        let form = "a stitch has a vertex, an edge and a share (`stitch i a b t`)";
        let [i, a, b, share] = numbers(&mut words, form)?;
        let index = |number: f64| match number.fract() == 0.0 && (0.0..2147483648.0).contains(&number) {
            true => Ok(number as u32),
            false => Err(format!("`{number}` is not a vertex; {form}, vertices count from 0")),
        };
        if !(-1e-6..=1.0 + 1e-6).contains(&share) {
            return Err(format!("the share {share} is not from 0 to 1; {form}"));
        }
        self.stitches.push(Stitch { vertex: index(i)?, edge: [index(a)?, index(b)?], share });
        Ok(())
    }

    pub(super) fn seam<'a>(&mut self, mut words: impl Iterator<Item = &'a [u8]>) -> Result<(), String> {
        let form = "a seam has a number of stitches (`seam n`)";
        let [count] = numbers(&mut words, form)?;
        if count.fract() != 0.0 || !(1.0..1e9).contains(&count) {
            return Err(format!("`{count}` is not a number of stitches; {form}"));
        }
        self.seams.push((self.stitches.len(), count as usize));
        Ok(())
    }

    /// The seams of a file of `vertices` vertices.
    ///
    /// # Errors
    /// A stitch names a vertex that is not there, or a seam has more stitches than follow it.
    pub(super) fn seams(self, vertices: usize) -> Result<Vec<FileSeam>, String> {
        for stitch in &self.stitches {
            let all = [stitch.vertex, stitch.edge[0], stitch.edge[1]];
            if let Some(vertex) = all.into_iter().find(|&vertex| vertex as usize >= vertices) {
                return Err(format!("a stitch names vertex {vertex}, but there are only {vertices} (from 0)"));
            }
        }
        // Without `seam` lines all stitches are one seam.
        let whole = [(0, self.stitches.len())];
        let seams = if self.seams.is_empty() && !self.stitches.is_empty() { &whole[..] } else { &self.seams };
        let mut all = Vec::with_capacity(seams.len());
        for (number, &(first, count)) in seams.iter().enumerate() {
            let Some(stitches) = self.stitches.get(first..first + count) else {
                let left = self.stitches.len().saturating_sub(first);
                return Err(format!("seam {number} has {count} stitches, but {left} follow it"));
            };
            let one: Vec<u32> = stitches.iter().map(|stitch| stitch.vertex).collect();
            let mut other: Vec<u32> =
                stitches.iter().map(|stitch| stitch.edge[usize::from(stitch.share >= 0.5)]).collect();
            other.dedup();
            // Files have some seams twice.
            if all.iter().all(|(_, sides): &FileSeam| sides[0] != one || sides[1] != other) {
                all.push((format!("{number}"), [one, other]));
            }
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use crate::mesh::parse_obj;

    const QUADS: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 3 0 0\nv 3 1 0\nv 2 1 0\n\
        f 1 2 3 4\nf 5 6 7 8\n";

    fn seams(lines: &str) -> Result<Vec<(String, [Vec<u32>; 2])>, String> {
        let surface = parse_obj(format!("{QUADS}{lines}").as_bytes()).map_err(|fault| fault.to_string())?;
        Ok(surface.seams)
    }

    #[test]
    fn stitches_become_the_sides_of_their_seam() {
        let found = seams("seam 3\nstitch 1 4 7 0\nstitch 2 4 7 5e-1\nstitch 2 4 7 1\n").unwrap();
        assert_eq!(found, [("0".to_owned(), [vec![1, 2, 2], vec![4, 7]])]);
        assert_eq!(seams("").unwrap(), []);
    }

    #[test]
    fn wrong_stitches_are_refused() {
        for (lines, word) in [
            ("seam 2\nstitch 1 4 7 0\n", "seam 0 has 2 stitches, but 1 follow it"),
            ("seam 1\nstitch 1 4 9 0\n", "a stitch names vertex 9, but there are only 8"),
            ("stitch 1 4 7 2\n", "the share 2 is not from 0 to 1"),
            ("stitch 1 4 7\n", "a stitch has a vertex, an edge and a share"),
            ("stitch 1.5 4 7 0\n", "`1.5` is not a vertex"),
            ("seam x\n", "`x` is not a number; a seam has a number of stitches"),
        ] {
            let error = seams(lines).unwrap_err();
            assert!(error.contains(word), "{error}");
        }
    }

    #[test]
    fn lines_in_groups_name_edges() {
        let text = format!("{QUADS}l 1 2\ng right\nl 2 3 # the side\nl 3/1 4/2\ng left\nl 5 8\n");
        let surface = parse_obj(text.as_bytes()).unwrap();
        let expected = [("right".to_owned(), vec![1, 2, 3]), ("left".to_owned(), vec![4, 7])];
        assert_eq!(surface.edges, expected);
    }
}
