//! Commands for a device: collected in the order of the calls until somebody waits.
//!
//! Parameters and small writes lie in one arena buffer that each submission uploads before its own commands, so the
//! arena is free again as soon as the commands are submitted.

use std::sync::{Arc, Mutex};

use super::fault::{Fault, locked};

/// Bytes of parameters and small writes that one submission can carry.
const ARENA_BYTES: usize = 256 << 10;
/// Writes up to this size go through the arena, larger ones through the queue.
const SMALL_WRITE_BYTES: usize = 32 << 10;
/// Bytes read or written at once; bounds what the driver allocates for it.
const PIECE_BYTES: usize = 32 << 20;

/// The commands of one device.
pub(super) struct Commands {
    device: wgpu::Device,
    queue: wgpu::Queue,
    fault: Arc<Fault>,
    arena: wgpu::Buffer,
    uniform_alignment: usize,
    pending: Mutex<Pending>,
}

/// Commands that are not submitted yet.
#[derive(Default)]
struct Pending {
    // The pass is recorded into the encoder and must end before it: fields drop in this order.
    pass: Option<wgpu::ComputePass<'static>>,
    encoder: Option<wgpu::CommandEncoder>,
    /// Contents of the arena when these commands run.
    arena: Vec<u8>,
    staging: Option<wgpu::Buffer>,
}

/// A dispatch of a compiled kernel.
pub(super) struct Dispatch<'a> {
    pub(super) pipeline: &'a wgpu::ComputePipeline,
    pub(super) bind_group: &'a wgpu::BindGroup,
    /// Parameters, and the bytes that the shader takes.
    pub(super) params: Option<(&'a [u8], u64)>,
    pub(super) groups: [u32; 2],
}

/// A part of a buffer on its way to the host.
pub(super) struct ReadPart<'a> {
    pub(super) buffer: &'a wgpu::Buffer,
    pub(super) offset: u64,
    pub(super) out: &'a mut [u8],
}

/// Some bytes of one [`ReadPart`]; a batch of pieces fills the staging buffer once.
struct Piece {
    part: usize,
    at: usize,
    bytes: usize,
}

impl Commands {
    pub(super) fn new(device: wgpu::Device, queue: wgpu::Queue, fault: Arc<Fault>) -> Commands {
        let arena = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("arena"),
            size: ARENA_BYTES as u64,
            usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let uniform_alignment = device.limits().min_uniform_buffer_offset_alignment as usize;
        Commands { device, queue, fault, arena, uniform_alignment, pending: Mutex::default() }
    }

    /// The buffer that parameters are bound from, at an offset that [`Commands::dispatch`] chooses.
    pub(super) fn arena(&self) -> &wgpu::Buffer {
        &self.arena
    }

    /// Nanoseconds of a tick of the device's clock; 0 if it has none.
    pub(super) fn tick_ns(&self) -> f64 {
        f64::from(self.queue.get_timestamp_period())
    }

    pub(super) fn dispatch(&self, dispatch: &Dispatch<'_>) {
        if self.fault.raised() {
            return;
        }
        let mut pending = locked(&self.pending);
        let offset = dispatch
            .params
            .map(|(bytes, size)| self.put(&mut pending, bytes, size as usize, self.uniform_alignment) as u32);
        let pass = self.pass(&mut pending);
        pass.set_pipeline(dispatch.pipeline);
        pass.set_bind_group(0, dispatch.bind_group, offset.as_slice());
        pass.dispatch_workgroups(dispatch.groups[0], dispatch.groups[1], 1);
    }

    /// Copies `bytes` bytes between two buffers.
    pub(super) fn copy(&self, from: &wgpu::Buffer, from_offset: u64, to: &wgpu::Buffer, to_offset: u64, bytes: u64) {
        if self.fault.raised() || bytes == 0 {
            return;
        }
        let mut pending = locked(&self.pending);
        self.encoder(&mut pending).copy_buffer_to_buffer(from, from_offset, to, to_offset, bytes);
    }

    /// Sets `bytes` bytes from `offset` on to 0.
    pub(super) fn clear(&self, buffer: &wgpu::Buffer, offset: u64, bytes: u64) {
        if self.fault.raised() || bytes == 0 {
            return;
        }
        let mut pending = locked(&self.pending);
        self.encoder(&mut pending).clear_buffer(buffer, offset, Some(bytes));
    }

    /// Adds whatever `record` asks for, such as render passes.
    pub(super) fn record(&self, record: impl FnOnce(&mut wgpu::CommandEncoder)) {
        if !self.fault.raised() {
            record(self.encoder(&mut locked(&self.pending)));
        }
    }

    /// Writes `bytes`: a few through the arena. For many, the commands so far are submitted first, because the queue's
    /// own writes overtake commands that are not submitted.
    pub(super) fn write(&self, buffer: &wgpu::Buffer, offset: u64, bytes: &[u8]) {
        if self.fault.raised() || bytes.is_empty() {
            return;
        }
        let mut pending = locked(&self.pending);
        if bytes.len() <= SMALL_WRITE_BYTES {
            let at = self.put(&mut pending, bytes, bytes.len(), wgpu::COPY_BUFFER_ALIGNMENT as usize) as u64;
            self.encoder(&mut pending).copy_buffer_to_buffer(&self.arena, at, buffer, offset, bytes.len() as u64);
            return;
        }
        self.submit(&mut pending);
        for (index, piece) in bytes.chunks(PIECE_BYTES).enumerate() {
            self.queue.write_buffer(buffer, offset + (index * PIECE_BYTES) as u64, piece);
            if bytes.len() > PIECE_BYTES {
                // Waiting for each piece lets the driver free its staging memory before the next one.
                self.queue.submit([]);
                self.wait();
            }
        }
    }

    /// Hands the commands so far to the device, without waiting for them.
    pub(super) fn flush(&self) {
        self.submit(&mut locked(&self.pending));
    }

    /// Waits until everything asked so far has been done.
    pub(super) fn finish(&self) {
        self.flush();
        self.wait();
    }

    /// Reads all parts with as few waits as possible; after a fault they are zeros.
    pub(super) fn read(&self, parts: &mut [ReadPart<'_>]) {
        let mut pending = locked(&self.pending);
        let mut batch: Vec<Piece> = Vec::new();
        let mut filled = 0;
        for part in 0..parts.len() {
            let mut at = 0;
            while at < parts[part].out.len() {
                let bytes = (parts[part].out.len() - at).min(PIECE_BYTES - filled);
                batch.push(Piece { part, at, bytes });
                at += bytes;
                filled += bytes;
                if filled == PIECE_BYTES {
                    self.read_batch(&mut pending, parts, &batch);
                    batch.clear();
                    filled = 0;
                }
            }
        }
        if filled > 0 {
            self.read_batch(&mut pending, parts, &batch);
        }
    }

    fn read_batch(&self, pending: &mut Pending, parts: &mut [ReadPart<'_>], batch: &[Piece]) {
        if !self.fault.raised() {
            match self.try_read_batch(pending, parts, batch) {
                Ok(()) => return,
                Err(reason) => self.fault.raise(format!("reading from the device failed ({reason}): it may be lost")),
            }
        }
        for &Piece { part, at, bytes } in batch {
            parts[part].out[at..at + bytes].fill(0);
        }
    }

    fn try_read_batch(&self, pending: &mut Pending, parts: &mut [ReadPart<'_>], batch: &[Piece]) -> Result<(), String> {
        let filled: usize = batch.iter().map(|piece| piece.bytes).sum();
        let staging = match pending.staging.take() {
            Some(buffer) if buffer.size() >= filled as u64 => buffer,
            _ => self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("read-back"),
                size: filled.next_power_of_two().max(4096) as u64,
                usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            }),
        };
        let mut target = 0;
        for &Piece { part, at, bytes } in batch {
            let ReadPart { buffer, offset, .. } = &parts[part];
            let encoder = self.encoder(pending);
            encoder.copy_buffer_to_buffer(buffer, offset + at as u64, &staging, target, bytes as u64);
            target += bytes as u64;
        }
        self.submit(pending);
        let (sender, receiver) = std::sync::mpsc::channel();
        staging.map_async(wgpu::MapMode::Read, 0..filled as u64, move |result| {
            // The receiver is gone only if this read was given up already.
            sender.send(result).ok();
        });
        self.wait();
        receiver.try_recv().map_err(|e| e.to_string())?.map_err(|e| e.to_string())?;
        let view = staging.get_mapped_range(0..filled as u64).map_err(|e| e.to_string())?;
        let mut source = 0;
        for &Piece { part, at, bytes } in batch {
            parts[part].out[at..at + bytes].copy_from_slice(&view[source..source + bytes]);
            source += bytes;
        }
        drop(view);
        staging.unmap();
        pending.staging = Some(staging);
        Ok(())
    }

    fn wait(&self) {
        if let Err(error) = self.device.poll(wgpu::PollType::wait_indefinitely()) {
            self.fault.raise(format!("waiting for the device failed ({error})"));
        }
    }

    /// Place in the arena of `bytes`, with `size >= bytes.len()` bytes to itself; submits the commands so far if it is
    /// full.
    fn put(&self, pending: &mut Pending, bytes: &[u8], size: usize, alignment: usize) -> usize {
        let mut at = pending.arena.len().next_multiple_of(alignment);
        if at + size > ARENA_BYTES {
            self.submit(pending);
            at = 0;
        }
        pending.arena.resize(at, 0);
        pending.arena.extend_from_slice(bytes);
        pending.arena.resize(at + size, 0);
        at
    }

    fn pass<'c>(&self, pending: &'c mut Pending) -> &'c mut wgpu::ComputePass<'static> {
        let Pending { pass, encoder, .. } = pending;
        pass.get_or_insert_with(|| {
            let encoder = encoder.get_or_insert_with(|| self.device.create_command_encoder(&Default::default()));
            encoder.begin_compute_pass(&Default::default()).forget_lifetime()
        })
    }

    fn encoder<'c>(&self, pending: &'c mut Pending) -> &'c mut wgpu::CommandEncoder {
        pending.pass = None;
        pending.encoder.get_or_insert_with(|| self.device.create_command_encoder(&Default::default()))
    }

    fn submit(&self, pending: &mut Pending) {
        pending.pass = None;
        let encoder = pending.encoder.take();
        if !self.fault.raised() {
            if !pending.arena.is_empty() {
                // The queue does this after all earlier submissions and before the commands of this one.
                let bytes = pending.arena.len().next_multiple_of(wgpu::COPY_BUFFER_ALIGNMENT as usize);
                pending.arena.resize(bytes, 0);
                self.queue.write_buffer(&self.arena, 0, &pending.arena);
            }
            self.queue.submit(encoder.map(|encoder| encoder.finish()));
        }
        pending.arena.clear();
    }
}
