// Index filling [Li et al. 2020, Sec. 3.2.2]; index_fill.rs describes the data flow between the four kernels. A row
// works on its own part of the table: one item for itself (own_column), then the corners of its contributions, kind a
// before kind b.

struct IndexParams {
    // Rows (or lanes, for index_place) of this dispatch.
    first_row: u32,
    rows: u32,
    // First item of the table that is bound.
    table_first: u32,
    // 1: every row has its diagonal column. 0: no row has it.
    own_column: u32,
    // Own rows among the local vertices.
    own_start: u32,
    own_end: u32,
    // Local vertices from here on have no column.
    columns: u32,
    corners_a: u32,
    corners_b: u32,
    // 0: contributions of kind a are bound, 1: of kind b.
    kind: u32,
    // Words of an element; its vertices come first.
    stride: u32,
    // Elements that are bound.
    first_element: u32,
    elements: u32,
    // Sub-vectors; 1 = rows are not cut.
    parts: u32,
    // Lanes of the layout.
    lanes: u32,
    padding0: u32,
}

const LANES: u32 = 16u;
const NO_COLUMN: u32 = 0xffffffffu;
const NO_ROW: u32 = 0xffffffffu;
const NO_POSITION: u32 = 0xffffu;
// Bit of a row's length: the row has columns of other ranks.
const REMOTE: u32 = 0x80000000u;

@group(0) @binding(0) var<storage, read> offsets_a: array<u32>;
@group(0) @binding(1) var<storage, read> offsets_b: array<u32>;
@group(0) @binding(2) var<storage, read> entries: array<u32>;
@group(0) @binding(3) var<storage, read> words: array<u32>;
@group(0) @binding(4) var<storage, read_write> table: array<u32>;
@group(0) @binding(5) var<storage, read> global_from_local: array<u32>;
@group(0) @binding(6) var<storage, read> part_ends: array<u32>;
@group(0) @binding(7) var<storage, read_write> lengths: array<u32>;
@group(0) @binding(8) var<storage, read_write> positions: array<vec2<u32>>;
@group(0) @binding(9) var<storage, read> lanes: array<vec4<u32>>;
@group(0) @binding(10) var<storage, read> slice_offsets: array<u32>;
@group(0) @binding(11) var<storage, read_write> sell_columns: array<u32>;
@group(0) @binding(12) var<storage, read> row_offsets: array<u32>;
@group(0) @binding(13) var<storage, read_write> block_address: array<u32>;
@group(0) @binding(14) var<uniform> params: IndexParams;

// Start of the row's part of the table.
fn row_start(r: u32) -> u32 {
    let before = params.own_column * r + params.corners_a * offsets_a[r] + params.corners_b * offsets_b[r];
    return before - params.table_first;
}

// Contributions of row r, of the bound kind.
fn contributions(r: u32) -> vec2<u32> {
    if (params.kind == 0u) {
        return vec2<u32>(offsets_a[r], offsets_a[r + 1u]);
    }
    return vec2<u32>(offsets_b[r], offsets_b[r + 1u]);
}

fn corners() -> u32 {
    return select(params.corners_a, params.corners_b, params.kind == 1u);
}

// Column of a corner of the e-th bound element, seen from its corner `own`.
fn column_of(e: u32, corner: u32, own: u32) -> u32 {
    let v = words[e * params.stride + corner];
    if (v >= params.columns || (params.own_column == 0u && corner == own)) {
        return NO_COLUMN;
    }
    return v;
}

// Key of a column: its global row. Items without a column sort last.
fn key(column: u32) -> u32 {
    if (column == NO_COLUMN) {
        return NO_COLUMN;
    }
    return global_from_local[column];
}

@compute @workgroup_size(WORKGROUP)
fn index_columns(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.rows) {
        return;
    }
    let r = params.first_row + i;
    var at = row_start(r);
    if (params.own_column == 1u) {
        table[at] = params.own_start + r;
        at += 1u;
    }
    if (params.kind == 1u) {
        at += params.corners_a * (offsets_a[r + 1u] - offsets_a[r]);
    }
    let list = contributions(r);
    let count = corners();
    for (var k = list.x; k < list.y; k++) {
        let e = (entries[k] >> 2u) - params.first_element;
        if (e < params.elements) {
            for (var corner = 0u; corner < count; corner++) {
                table[at + corner] = column_of(e, corner, entries[k] & 3u);
            }
        }
        at += count;
    }
}

// Sifts item `start` of the heap of n items at `base` down.
fn sift(base: u32, start: u32, n: u32) {
    var root = start;
    let value = table[base + root];
    let value_key = key(value);
    loop {
        var child = 2u * root + 1u;
        if (child >= n) {
            break;
        }
        if (child + 1u < n && key(table[base + child + 1u]) > key(table[base + child])) {
            child += 1u;
        }
        if (key(table[base + child]) <= value_key) {
            break;
        }
        table[base + root] = table[base + child];
        root = child;
    }
    table[base + root] = value;
}

fn heap_sort(base: u32, n: u32) {
    for (var i = n / 2u; i > 0u; i--) {
        sift(base, i - 1u, n);
    }
    for (var end = n; end > 1u; end--) {
        let largest = table[base];
        table[base] = table[base + end - 1u];
        table[base + end - 1u] = largest;
        sift(base, 0u, end - 1u);
    }
}

@compute @workgroup_size(WORKGROUP)
fn index_compact(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.rows) {
        return;
    }
    let r = params.first_row + i;
    let base = row_start(r);
    let n = row_start(r + 1u) - base;
    heap_sort(base, n);
    var kept = 0u;
    var remote = 0u;
    var part = 0u;
    var part_length = 0u;
    for (var k = 0u; k < n; k++) {
        let v = table[base + k];
        if (v == NO_COLUMN) {
            break;
        }
        if (kept > 0u && table[base + kept - 1u] == v) {
            continue;
        }
        table[base + kept] = v;
        kept += 1u;
        if (v < params.own_start || v >= params.own_end) {
            remote = REMOTE;
        }
        if (params.parts > 1u) {
            while (global_from_local[v] >= part_ends[part]) {
                lengths[r * params.parts + part] = part_length;
                part_length = 0u;
                part += 1u;
            }
            part_length += 1u;
        }
    }
    if (params.parts == 1u) {
        lengths[r] = kept | remote;
        return;
    }
    for (; part < params.parts; part++) {
        lengths[r * params.parts + part] = part_length;
        part_length = 0u;
    }
}

fn row_length(r: u32) -> u32 {
    var length = 0u;
    for (var part = 0u; part < params.parts; part++) {
        length += lengths[r * params.parts + part] & ~REMOTE;
    }
    return length;
}

// Position of a column among the columns of the row, which contain it.
fn position_of(column: u32, base: u32, length: u32) -> u32 {
    if (column == NO_COLUMN) {
        return NO_POSITION;
    }
    let wanted = global_from_local[column];
    var low = 0u;
    var high = length;
    while (high - low > 1u) {
        let middle = (low + high) / 2u;
        if (global_from_local[table[base + middle]] <= wanted) {
            low = middle;
        } else {
            high = middle;
        }
    }
    return low;
}

@compute @workgroup_size(WORKGROUP)
fn index_positions(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.rows) {
        return;
    }
    let r = params.first_row + i;
    let base = row_start(r);
    let length = row_length(r);
    let list = contributions(r);
    let count = corners();
    for (var k = list.x; k < list.y; k++) {
        let e = (entries[k] >> 2u) - params.first_element;
        if (e >= params.elements) {
            continue;
        }
        var found = vec4<u32>(NO_POSITION);
        for (var corner = 0u; corner < count; corner++) {
            found[corner] = position_of(column_of(e, corner, entries[k] & 3u), base, length);
        }
        positions[k] = vec2<u32>(found.x | (found.y << 16u), found.z | (found.w << 16u));
    }
}

@compute @workgroup_size(WORKGROUP)
fn index_place(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = global_index(id, groups);
    if (i >= params.lanes) {
        return;
    }
    let start = slice_offsets[i / LANES];
    let width = slice_offsets[i / LANES + 1u] - start;
    let address = start * LANES + i % LANES;
    let row = lanes[i].x;
    let first = lanes[i].z;
    let length = lanes[i].w;
    if (row == NO_ROW) {
        for (var k = 0u; k < width; k++) {
            sell_columns[address + k * LANES] = 0u;
        }
        return;
    }
    if (row - params.first_row >= params.rows) {
        return;
    }
    let base = row_start(row) + first;
    var column = 0u;
    for (var k = 0u; k < width; k++) {
        // Padding repeats the last column.
        if (k < length) {
            column = table[base + k];
            if (params.parts > 1u) {
                let part = lanes[i].y;
                column = global_from_local[column];
                if (part > 0u) {
                    column -= part_ends[part - 1u];
                }
            }
            if (params.own_column == 1u) {
                block_address[row_offsets[row] + first + k] = address + k * LANES;
            }
        }
        sell_columns[address + k * LANES] = column;
    }
}
