//! Pictures of triangle meshes, drawn by the device into memory: the host's side of `offscreen.wgsl`.
//!
//! It draws what `output/picture/` draws on the processor, with the same samples and the same shading; the two differ
//! by roundings and in which of two surfaces a sample on an edge belongs to. Large pictures are drawn in tiles, so
//! that no size is too large for an adapter.

use bytemuck::{Pod, Zeroable, bytes_of, cast_slice};

use super::array::GpuArray;
use super::device::GpuExecutor;
use super::{Executor, GpuError, gpu_struct};

const TEXT: &str = include_str!("offscreen.wgsl");
/// Pixels along a tile at most. Its samples and depths need 48 MiB.
const TILE: u32 = 1024;
/// Samples along each side of a pixel.
const SAMPLES: u32 = 2;
const SAMPLE_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
const DEPTH_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;
const PIXEL_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8UnormSrgb;

/// Directions that light comes from.
pub const LIGHTS: usize = 64;
/// Those of them that belong to the main light; they come first.
pub const LIGHTS_OF_KEY: usize = 24;
/// Texels along a light's map.
pub const LIGHT_SIDE: usize = 384;

/// A corner of triangles. Colors are linear.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct DrawVertex {
    /// World position, meters, finite.
    pub position: [f32; 3],
    /// Direction that the front faces; any length, zero = up.
    pub normal: [f32; 3],
    /// Color of the front.
    pub front: [f32; 3],
    /// Color of the back.
    pub back: [f32; 3],
    /// 1 = cloth, 0 = obstacle; the same for all corners of a triangle.
    pub cloth: u32,
}

gpu_struct! {
    /// Camera and light of a picture. Vectors have a fourth component that is unused.
    pub struct DrawLook {
        /// Position of the camera, meters.
        pub eye: [f32; 4],
        /// Unit vector to the right.
        pub right: [f32; 4],
        /// Unit vector to the top of the picture.
        pub up: [f32; 4],
        /// Unit vector into the picture.
        pub forward: [f32; 4],
        /// Against gravity: the y or the z axis.
        pub world_up: [f32; 4],
        /// Unit vector towards the main light.
        pub key_light: [f32; 4],
        /// Unit vector towards the weak light.
        pub fill_light: [f32; 4],
        /// Linear color of the background's top.
        pub sky_top: [f32; 4],
        /// Linear color of the background's bottom.
        pub sky_bottom: [f32; 4],
        /// Half the picture's width and height at distance 1; samples per row and rows of samples (two a pixel).
        pub half_and_samples: [f32; 4],
        /// Height of the ground, distance of its grid lines (meters); 1 = there is a ground; 1 = cloth shows its
        /// direction instead of its color.
        pub ground: [f32; 4],
        /// Depth where surfaces begin, meters; a texel of a light's map, meters; 1 = there are maps.
        pub near: [f32; 4],
        /// Column of a point in a light's map: with its coordinates and 1.
        pub light_columns: [[f32; 4]; LIGHTS],
        /// Row of a point in a light's map.
        pub light_rows: [[f32; 4]; LIGHTS],
        /// Height of a point towards a light, meters; the first three are the direction.
        pub light_heights: [[f32; 4]; LIGHTS],
    }
}

gpu_struct! {
    /// A tile of the picture.
    struct DrawTile { clip_scale: [f32; 2], clip_shift: [f32; 2], first: [f32; 2], pad: [f32; 2] }
}

/// A place to draw pictures of one size.
pub struct Offscreen<'a> {
    gpu: &'a GpuExecutor,
    width: u32,
    height: u32,
    tile: (u32, u32),
    targets: Targets,
    pipelines: Pipelines,
    look: wgpu::Buffer,
    layout: wgpu::BindGroupLayout,
    /// Heights of the nearest surfaces towards the lights.
    maps: wgpu::Buffer,
    tile_params: wgpu::Buffer,
    bind_group: wgpu::BindGroup,
    resolve_group: wgpu::BindGroup,
    vertices: wgpu::Buffer,
    triangles: wgpu::Buffer,
    /// Pixels of a tile on their way to the host.
    read_back: GpuArray,
}

struct Targets {
    samples: wgpu::TextureView,
    depth: wgpu::TextureView,
    pixels: wgpu::Texture,
}

struct Pipelines {
    background: wgpu::RenderPipeline,
    surface: wgpu::RenderPipeline,
    resolve: wgpu::RenderPipeline,
}

impl<'a> Offscreen<'a> {
    /// A place for pictures of `width` x `height` pixels; None on the native executor, which does not draw.
    ///
    /// # Errors
    /// The device refused the shader or has no memory for a tile.
    pub fn new(executor: &'a Executor, width: u32, height: u32) -> Result<Option<Offscreen<'a>>, GpuError> {
        let Executor::Gpu(gpu) = executor else { return Ok(None) };
        let device = gpu.device();
        let tile = (width.clamp(1, TILE), height.clamp(1, TILE));
        let targets = Targets::new(device, tile);
        let layout = bind_group_layout(device);
        let pipelines = Pipelines::new(device, &layout);
        let uniform = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST;
        let look = buffer(device, size_of::<DrawLook>() as u64, uniform);
        let tile_params = buffer(device, size_of::<DrawTile>() as u64, uniform);
        let maps = buffer(device, 1 << 8, wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST);
        let bind_group = look_group(device, &layout, &look, &tile_params, &maps);
        let resolve_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("samples"),
            layout: &pipelines.resolve.get_bind_group_layout(0),
            entries: &[wgpu::BindGroupEntry {
                binding: 2,
                resource: wgpu::BindingResource::TextureView(&targets.samples),
            }],
        });
        let (vertices, triangles) = (
            buffer(device, 1 << 16, wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_DST),
            buffer(device, 1 << 16, wgpu::BufferUsages::INDEX | wgpu::BufferUsages::COPY_DST),
        );
        let read_back = gpu.allocate(u64::from(row_bytes(tile.0)) * u64::from(tile.1));
        let place = Offscreen {
            gpu,
            width,
            height,
            tile,
            targets,
            pipelines,
            look,
            layout,
            maps,
            tile_params,
            bind_group,
            resolve_group,
            vertices,
            triangles,
            read_back,
        };
        gpu.finish();
        gpu.fault().map_or(Ok(Some(place)), Err)
    }

    /// Draws triangles (all indices valid, counter-clockwise where the front is seen). Returns sRGB with 4 bytes a
    /// pixel, row by row from the top. `maps`: by light, row by row; none if `look` says that there are none.
    ///
    /// # Errors
    /// The mesh does not fit on the device, or the device failed; then nothing can be drawn any more.
    pub fn draw(
        &mut self,
        vertices: &[DrawVertex],
        triangles: &[[u32; 3]],
        look: &DrawLook,
        maps: &[f32],
    ) -> Result<Vec<u8>, GpuError> {
        let (vertex_bytes, triangle_bytes) = (cast_slice::<_, u8>(vertices), cast_slice::<_, u8>(triangles));
        fill(self.gpu, &mut self.vertices, vertex_bytes);
        fill(self.gpu, &mut self.triangles, triangle_bytes);
        if !maps.is_empty() {
            let before = self.maps.size();
            fill(self.gpu, &mut self.maps, cast_slice(maps));
            if self.maps.size() != before {
                let device = self.gpu.device();
                self.bind_group = look_group(device, &self.layout, &self.look, &self.tile_params, &self.maps);
            }
        }
        self.gpu.commands().write(&self.look, 0, bytes_of(look));
        let mut picture = vec![0; self.width as usize * self.height as usize * 4];
        for top in (0..self.height).step_by(TILE as usize) {
            for left in (0..self.width).step_by(TILE as usize) {
                self.draw_tile(left, top, triangles.len() as u32 * 3);
                self.read_tile(left, top, &mut picture);
            }
        }
        self.gpu.fault().map_or(Ok(picture), Err)
    }

    fn draw_tile(&self, left: u32, top: u32, indices: u32) {
        let whole = [self.width as f32, self.height as f32];
        let (tile, first) = ([self.tile.0 as f32, self.tile.1 as f32], [left as f32, top as f32]);
        let scale = [whole[0] / tile[0], whole[1] / tile[1]];
        // Clip coordinates point up, places in a picture down.
        let shift = [scale[0] - 1.0 - 2.0 * first[0] / tile[0], 1.0 - scale[1] + 2.0 * first[1] / tile[1]];
        let first = first.map(|pixel| pixel * SAMPLES as f32);
        let params = DrawTile { clip_scale: scale, clip_shift: shift, first, pad: [0.0; 2] };
        self.gpu.commands().write(&self.tile_params, 0, bytes_of(&params));
        let pixels = self.targets.pixels.create_view(&Default::default());
        self.gpu.commands().record(|encoder| {
            let depth = wgpu::RenderPassDepthStencilAttachment {
                view: &self.targets.depth,
                depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard }),
                stencil_ops: None,
            };
            let mut pass = begin(encoder, &self.targets.samples, Some(depth));
            pass.set_bind_group(0, &self.bind_group, &[]);
            pass.set_pipeline(&self.pipelines.background);
            pass.draw(0..3, 0..1);
            if indices > 0 {
                pass.set_pipeline(&self.pipelines.surface);
                pass.set_vertex_buffer(0, self.vertices.slice(..));
                pass.set_index_buffer(self.triangles.slice(..), wgpu::IndexFormat::Uint32);
                pass.draw_indexed(0..indices, 0, 0..1);
            }
            drop(pass);
            let mut pass = begin(encoder, &pixels, None);
            pass.set_bind_group(0, &self.resolve_group, &[]);
            pass.set_pipeline(&self.pipelines.resolve);
            pass.draw(0..3, 0..1);
            drop(pass);
            let layout = wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(row_bytes(self.tile.0)),
                rows_per_image: None,
            };
            let to = wgpu::TexelCopyBufferInfo { buffer: &self.read_back.buffer, layout };
            encoder.copy_texture_to_buffer(self.targets.pixels.as_image_copy(), to, extent(self.tile));
        });
    }

    /// Copies the tile's pixels to their place in the picture.
    fn read_tile(&self, left: u32, top: u32, picture: &mut [u8]) {
        let (columns, rows) = (self.tile.0.min(self.width - left), self.tile.1.min(self.height - top));
        let stride = row_bytes(self.tile.0) as usize;
        let mut bytes = vec![0; stride * rows as usize];
        self.gpu.commands().read(&mut [self.read_back.read_part(0, &mut bytes)]);
        for (row, pixels) in bytes.chunks_exact(stride).enumerate() {
            let to = ((top as usize + row) * self.width as usize + left as usize) * 4;
            picture[to..to + columns as usize * 4].copy_from_slice(&pixels[..columns as usize * 4]);
        }
    }
}

impl Targets {
    fn new(device: &wgpu::Device, tile: (u32, u32)) -> Targets {
        let texture = |size, format, usage| {
            device.create_texture(&wgpu::TextureDescriptor {
                label: Some("picture"),
                size: extent(size),
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT | usage,
                view_formats: &[],
            })
        };
        let samples = (tile.0 * SAMPLES, tile.1 * SAMPLES);
        Targets {
            samples: texture(samples, SAMPLE_FORMAT, wgpu::TextureUsages::TEXTURE_BINDING)
                .create_view(&Default::default()),
            depth: texture(samples, DEPTH_FORMAT, wgpu::TextureUsages::empty()).create_view(&Default::default()),
            pixels: texture(tile, PIXEL_FORMAT, wgpu::TextureUsages::COPY_SRC),
        }
    }
}

impl Pipelines {
    fn new(device: &wgpu::Device, layout: &wgpu::BindGroupLayout) -> Pipelines {
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("gpu/offscreen.wgsl"),
            source: wgpu::ShaderSource::Wgsl(TEXT.into()),
        });
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &[Some(layout)],
            immediate_size: 0,
        });
        let depth = |compare, write| wgpu::DepthStencilState {
            format: DEPTH_FORMAT,
            depth_write_enabled: Some(write),
            depth_compare: Some(compare),
            stencil: Default::default(),
            bias: Default::default(),
        };
        let corners = wgpu::VertexBufferLayout {
            array_stride: size_of::<DrawVertex>() as u64,
            step_mode: wgpu::VertexStepMode::Vertex,
            attributes: &wgpu::vertex_attr_array![
                0 => Float32x3, 1 => Float32x3, 2 => Float32x3, 3 => Float32x3, 4 => Uint32
            ],
        };
        let make = |vertex, fragment, layout, buffers: &[Option<wgpu::VertexBufferLayout<'_>>], depth, format| {
            device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
                label: Some(fragment),
                layout,
                vertex: wgpu::VertexState {
                    module: &module,
                    entry_point: Some(vertex),
                    compilation_options: Default::default(),
                    buffers,
                },
                // Counter-clockwise is the front; both sides are drawn.
                primitive: Default::default(),
                depth_stencil: depth,
                multisample: Default::default(),
                fragment: Some(wgpu::FragmentState {
                    module: &module,
                    entry_point: Some(fragment),
                    compilation_options: Default::default(),
                    targets: &[Some(wgpu::TextureFormat::into(format))],
                }),
                multiview_mask: None,
                cache: None,
            })
        };
        let (always, nearer) =
            (depth(wgpu::CompareFunction::Always, false), depth(wgpu::CompareFunction::Greater, true));
        Pipelines {
            background: make("screen_corner", "background", Some(&layout), &[], Some(always), SAMPLE_FORMAT),
            surface: make("surface_corner", "surface", Some(&layout), &[Some(corners)], Some(nearer), SAMPLE_FORMAT),
            resolve: make("screen_corner", "resolve", None, &[], None, PIXEL_FORMAT),
        }
    }
}

fn bind_group_layout(device: &wgpu::Device) -> wgpu::BindGroupLayout {
    let entry = |binding, ty| wgpu::BindGroupLayoutEntry {
        binding,
        visibility: wgpu::ShaderStages::VERTEX_FRAGMENT,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    };
    let maps = wgpu::BindGroupLayoutEntry {
        visibility: wgpu::ShaderStages::FRAGMENT,
        ..entry(3, wgpu::BufferBindingType::Storage { read_only: true })
    };
    let uniform = |binding| entry(binding, wgpu::BufferBindingType::Uniform);
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some("look, tile and light"),
        entries: &[uniform(0), uniform(1), maps],
    })
}

fn look_group(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    look: &wgpu::Buffer,
    tile: &wgpu::Buffer,
    maps: &wgpu::Buffer,
) -> wgpu::BindGroup {
    device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some("look, tile and light"),
        layout,
        entries: &[
            wgpu::BindGroupEntry { binding: 0, resource: look.as_entire_binding() },
            wgpu::BindGroupEntry { binding: 1, resource: tile.as_entire_binding() },
            wgpu::BindGroupEntry { binding: 3, resource: maps.as_entire_binding() },
        ],
    })
}

/// A pass that writes every pixel of `target`.
fn begin<'e>(
    encoder: &'e mut wgpu::CommandEncoder,
    target: &wgpu::TextureView,
    depth: Option<wgpu::RenderPassDepthStencilAttachment<'_>>,
) -> wgpu::RenderPass<'e> {
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some("picture"),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: target,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
        })],
        depth_stencil_attachment: depth,
        ..Default::default()
    })
}

/// Puts `bytes` into `target`, which is made anew where it is too small.
fn fill(gpu: &GpuExecutor, target: &mut wgpu::Buffer, bytes: &[u8]) {
    let most = gpu.limits().max_buffer_size.min(u64::from(u32::MAX));
    if bytes.len() as u64 > most {
        let name = gpu.adapter().describe();
        gpu.stop(format!(
            "a mesh of {} bytes does not fit on {name}, whose largest array is {most} bytes",
            bytes.len()
        ));
        return;
    }
    if bytes.len() as u64 > target.size() {
        let size = (bytes.len() as u64).next_power_of_two().min(most / 4 * 4);
        *target = buffer(gpu.device(), size, target.usage());
    }
    gpu.commands().write(target, 0, bytes);
}

fn buffer(device: &wgpu::Device, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
    device.create_buffer(&wgpu::BufferDescriptor { label: Some("picture"), size, usage, mapped_at_creation: false })
}

fn extent((width, height): (u32, u32)) -> wgpu::Extent3d {
    wgpu::Extent3d { width, height, depth_or_array_layers: 1 }
}

/// Bytes from one row of pixels to the next in the buffer that is read back.
fn row_bytes(width: u32) -> u32 {
    (width * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{GpuStruct, kernel, layout};
    use crate::test_support::device;

    #[test]
    fn the_shader_is_valid_and_laid_out_like_rust() {
        let (module, _) = kernel::validate(TEXT, TEXT).unwrap();
        layout::check(&module, &DrawLook::LAYOUT).unwrap();
        layout::check(&module, &DrawTile::LAYOUT).unwrap();
    }

    /// Looks along -z at the square |x| < 1, |y| < 1 of the plane z = 0, from z = 10.
    fn look(width: u32, height: u32) -> DrawLook {
        let gray = |x: f32| [x, x, x, 0.0];
        DrawLook {
            eye: [0.0, 0.0, 10.0, 0.0],
            right: [1.0, 0.0, 0.0, 0.0],
            up: [0.0, 1.0, 0.0, 0.0],
            forward: [0.0, 0.0, -1.0, 0.0],
            world_up: [0.0, 1.0, 0.0, 0.0],
            key_light: [0.0, 0.0, 1.0, 0.0],
            fill_light: [0.0, 0.0, 1.0, 0.0],
            sky_top: gray(0.0),
            sky_bottom: gray(0.0),
            half_and_samples: [0.1, 0.1, (width * SAMPLES) as f32, (height * SAMPLES) as f32],
            ground: [100.0, 1.0, 1.0, 0.0],
            near: [0.1, 1.0, 0.0, 0.0],
            light_columns: [gray(0.0); LIGHTS],
            light_rows: [gray(0.0); LIGHTS],
            // All of them shine along the line of sight.
            light_heights: [[0.0, 0.0, 1.0, 0.0]; LIGHTS],
        }
    }

    /// A square with corners at +-`half` whose front faces +z.
    fn square(half: f32, z: f32, first: u32) -> ([DrawVertex; 4], [[u32; 3]; 2]) {
        let corner = |x: f32, y: f32| DrawVertex {
            position: [x * half, y * half, z],
            normal: [0.0, 0.0, 1.0],
            front: [0.3; 3],
            back: [1.0; 3],
            cloth: 1,
        };
        let corners = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        (corners, [[first, first + 1, first + 2], [first, first + 2, first + 3]])
    }

    #[test]
    fn the_nearest_surface_is_seen_in_every_tile() {
        let Some(executor) = device::executor() else { return };
        // Two tiles along each side, the second ones cut off.
        let (width, height) = (TILE + 77, TILE + 30);
        let mut place = Offscreen::new(&executor, width, height).unwrap().unwrap();
        let (far, near) = (square(0.5, 0.0, 0), square(0.25, 1.0, 4));
        // The near square turned round: its back is seen.
        let turned = near.1.map(|[a, b, c]| [a, c, b]);
        let picture =
            place.draw(&[far.0, near.0].concat(), &[turned, far.1].concat(), &look(width, height), &[]).unwrap();
        // The near square turns its back, which no light reaches, the far one its bright front.
        let count = |value: std::ops::Range<u8>| picture.chunks_exact(4).filter(|p| value.contains(&p[0])).count();
        let area = |share: f64| share * share * f64::from(width) * f64::from(height);
        let (back, front) = (area(0.25 * 10.0 / 9.0), area(0.5) - area(0.25 * 10.0 / 9.0));
        let (dark, bright) = (count(40..140), count(140..255));
        assert!((dark as f64 / back - 1.0).abs() < 0.02, "{dark} of {back}");
        assert!((bright as f64 / front - 1.0).abs() < 0.02, "{bright} of {front}");
        // Nothing but the background is left when the mesh is gone.
        let empty = place.draw(&[], &[], &look(width, height), &[]).unwrap();
        assert!(empty.chunks_exact(4).all(|p| p[..3] == [0; 3]));
    }

    #[test]
    fn the_native_executor_does_not_draw() {
        assert!(Offscreen::new(&Executor::cpu(1), 8, 8).unwrap().is_none());
    }
}
