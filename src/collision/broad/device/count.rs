//! Counts the layers that a rank's share of the tests lies in. The ranks then split the tests evenly, as in a native
//! search. Host code around the passes of `hash`.

use std::ops::Range;
use std::sync::Arc;

use super::batches::{BINDING_BYTES, Chunk};
use super::hash::{DeviceTable, HashParams, Shapes, Window};
use super::space::Space;
use crate::collision::broad::input::Input;
use crate::collision::broad::patches::Patches;
use crate::collision::broad::workload::{LayerLoad, Workload, layers_of};
use crate::collision::broad::{BroadError, CollisionMesh, Query, Split};
use crate::gpu::{DeviceVec, Executor};

/// Number of tests that ranks exchange for a layer with a chunk that is too large for one dispatch.
const TOO_MANY: u64 = u64::MAX;

/// Counts layers of space for one mesh. Keeps its arrays from query to query.
pub(super) struct Counter {
    mesh: Arc<CollisionMesh>,
    /// Per vertex the number of its piece.
    pieces: Vec<u32>,
    pub shapes: Shapes,
    /// The triangles whose faces are on the device.
    members: Vec<u32>,
    pub table: DeviceTable,
}

/// Result of counting.
pub(super) struct Counted {
    pub params: HashParams,
    pub chunks: Vec<Chunk>,
    pub workload: Workload,
    /// The rank's tests, numbered from the first of the window.
    pub share: Range<u64>,
    /// Bytes of lists on the host.
    pub host_bytes: u64,
}

/// Pieces numbered from 0.
pub(super) fn numbered_pieces(mesh: &CollisionMesh) -> Vec<u32> {
    let mut numbers = vec![0u32; mesh.vertices];
    let mut next = 0;
    // The smallest vertex of a piece comes before its others.
    for (v, &piece) in mesh.pieces.iter().enumerate() {
        numbers[v] = if piece as usize == v { next } else { numbers[piece as usize] };
        next += u32::from(piece as usize == v);
    }
    numbers
}

/// Corners, owned features and number of the piece of a triangle.
pub(super) fn face(mesh: &CollisionMesh, pieces: &[u32], triangle: u32) -> [u32; 4] {
    let [a, b, c] = mesh.triangles[triangle as usize];
    [a, b, c, u32::from(mesh.owned[triangle as usize]) | pieces[a as usize] << 6]
}

/// Of the chunks of a layer.
fn layer_load(chunks: &[Chunk]) -> LayerLoad {
    if chunks.iter().any(Chunk::is_too_much) {
        return LayerLoad::of(TOO_MANY, 0, 0);
    }
    let busy = chunks.iter().map(|chunk| chunk.busy).sum();
    let entries = chunks.iter().map(|chunk| chunk.entries as u32).sum();
    LayerLoad::of(chunks.iter().map(|chunk| chunk.tests).sum(), busy, entries)
}

impl Counter {
    pub(super) fn new(executor: &Executor, mesh: &Arc<CollisionMesh>) -> Counter {
        Counter {
            mesh: Arc::clone(mesh),
            pieces: numbered_pieces(mesh),
            shapes: Shapes { x_t0: DeviceVec::zeros(executor, 0), x_t1: None, faces: DeviceVec::zeros(executor, 0) },
            members: Vec::new(),
            table: DeviceTable::new(executor),
        }
    }

    /// Bytes of what follows from the mesh alone.
    pub(super) fn mesh_bytes(&self) -> u64 {
        size_of_val(&self.pieces[..]) as u64
    }

    /// Bytes of faces and table on the device.
    pub(super) fn bytes(&self) -> u64 {
        self.shapes.faces.held_bytes() + self.table.bytes()
    }

    /// Gives back what queries leave for the next one.
    pub(super) fn drop_arrays(&mut self, executor: &Executor) {
        self.members = Vec::new();
        self.shapes.faces = DeviceVec::zeros(executor, 0);
        self.table = DeviceTable::new(executor);
    }

    /// Positions of a query.
    pub(super) fn upload(&mut self, executor: &Executor, query: &Query) {
        self.shapes.x_t0.assign(executor, query.x_t0);
        if std::ptr::eq(query.x_t0, query.x_t1) {
            self.shapes.x_t1 = None;
        } else {
            let end = self.shapes.x_t1.get_or_insert_with(|| DeviceVec::zeros(executor, 0));
            end.assign(executor, query.x_t1);
        }
    }

    /// Counts the layers that hold this rank's share of the tests: those that it is likely to need, then, if they do not,
    /// those that do. None if all ranks leave the search to native code. Between ranks: 16 bytes per layer.
    ///
    /// # Errors
    /// A fault of the device; another rank is not heard.
    pub(super) fn count(
        &mut self,
        executor: &Executor,
        input: &Input,
        patches: &Patches,
        split: &mut Split,
    ) -> Result<Option<Counted>, BroadError> {
        let (rank, ranks) = split.place();
        let space = Space::new(input, patches);
        if space.buckets() > BINDING_BYTES / size_of::<[u32; 4]>() {
            return Ok(None);
        }
        let guess = if split.is_together() { space.guess(rank, ranks) } else { 0..space.layers() };
        let mut loads = vec![LayerLoad::default(); space.layers()];
        let (mut window, mut chunks) = self.count_window(executor, (input, patches, &space), guess.clone());
        let mut of_layers = &chunks[..];
        for layer in guess.clone() {
            let (own, others) = of_layers.split_at(space.chunks_of(layer));
            loads[layer] = layer_load(own);
            of_layers = others;
        }
        if let Some(fault) = executor.take_fault() {
            return Err(BroadError::Device(fault));
        }
        split.share(&mut loads, |rank| space.guess(rank, ranks))?;
        if loads.iter().any(|load| load.tests() == TOO_MANY) {
            return Ok(None);
        }
        let mut workload = Workload::default();
        workload.add_up(&loads);
        let share = workload.share(rank, ranks);
        let needed = layers_of(&loads, &share);
        if needed.start < guess.start || needed.end > guess.end {
            (window, chunks) = self.count_window(executor, (input, patches, &space), needed);
        }
        let before: u64 = loads[..window.layers.start].iter().map(LayerLoad::tests).sum();
        let share = share.start.max(before) - before..share.end.max(before) - before;
        let host_bytes = space.bytes() + window.bytes() + 4 * self.members.capacity() as u64;
        Ok(Some(Counted { params: window.params, chunks, workload, share, host_bytes }))
    }

    fn count_window(
        &mut self,
        executor: &Executor,
        (input, patches, space): (&Input, &Patches, &Space),
        layers: Range<usize>,
    ) -> (Window, Vec<Chunk>) {
        let members = space.members(input, patches, &layers);
        let window = space.window(input, layers, &members);
        if members != self.members {
            let faces: Vec<_> = members.iter().map(|&t| face(&self.mesh, &self.pieces, t)).collect();
            self.shapes.faces.assign(executor, &faces);
            self.members = members;
        }
        let loads = if window.chunks.is_empty() { vec![] } else { self.table.count(executor, &window, &self.shapes) };
        let chunks = window.chunks.iter().zip(loads).map(|(&buckets, load)| Chunk::new(buckets, load)).collect();
        (window, chunks)
    }
}
