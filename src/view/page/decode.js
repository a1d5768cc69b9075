// A worker: fetches frames, decodes them and computes normals, so that the page stays free to draw. src/view/layer.rs
// says what the bytes are.

const MESH = 0x314d544c;
const FRAME = 0x3146544c;
/** Obstacles keep edges at which their triangles meet more sharply: cosine of 40 degrees. */
const SMOOTH = 0.766;

/** By layer (a run, or the coarse run of one) and mesh: triangles, and the triangles of the obstacles. */
const meshes = new Map();

async function fetched(url) {
  const response = await fetch(url);
  // What cannot be had now comes as a sentence.
  if (!response.ok || response.headers.get("Content-Type") === "application/json") {
    const answer = await response.json().catch(() => ({}));
    throw new Error(answer.error || `${response.status}`);
  }
  return response.arrayBuffer();
}

/** The mesh of a frame. A run that sews has another one later. */
async function mesh(key, url) {
  const buffer = await fetched(url);
  const head = new Uint32Array(buffer, 0, 8);
  if (head[0] !== MESH) throw new Error("this is no mesh");
  const [, vertices, triangles, obstacleVertices, obstacleTriangles, pieces] = head;
  const cloth = new Uint32Array(buffer, 32, 3 * triangles);
  const obstacle = new Uint32Array(buffer, 32 + 12 * triangles, 3 * obstacleTriangles);
  const piece = new Uint16Array(buffer, 32 + 12 * (triangles + obstacleTriangles), vertices);
  const made = { vertices, cloth, obstacle, obstacleVertices };
  meshes.set(key, made);
  const shown = { vertices, pieces, triangles: cloth.slice(), piece: piece.slice(), obstacleTriangles };
  return { made, shown };
}

/** Normals of vertices, weighted by area, as 16-bit numbers with a fourth one to pad. */
function normals(positions, triangles, vertices) {
  const sum = new Float32Array(3 * vertices);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
    const px = positions[b] - positions[a], py = positions[b + 1] - positions[a + 1], pz = positions[b + 2] - positions[a + 2];
    const qx = positions[c] - positions[a], qy = positions[c + 1] - positions[a + 1], qz = positions[c + 2] - positions[a + 2];
    const nx = py * qz - pz * qy, ny = pz * qx - px * qz, nz = px * qy - py * qx;
    sum[a] += nx; sum[a + 1] += ny; sum[a + 2] += nz;
    sum[b] += nx; sum[b + 1] += ny; sum[b + 2] += nz;
    sum[c] += nx; sum[c + 1] += ny; sum[c + 2] += nz;
  }
  return sum;
}

function packed(sum, vertices) {
  const out = new Int16Array(4 * vertices);
  for (let v = 0; v < vertices; v++) {
    const [x, y, z] = [sum[3 * v], sum[3 * v + 1], sum[3 * v + 2]];
    const scale = 32767 / (Math.sqrt(x * x + y * y + z * z) || 1);
    out[4 * v] = x * scale; out[4 * v + 1] = y * scale; out[4 * v + 2] = z * scale;
  }
  return out;
}

function bounds(positions) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < positions.length; i += 3) {
    for (let k = 0; k < 3; k++) {
      const v = positions[i + k];
      if (v < low[k]) low[k] = v;
      if (v > high[k]) high[k] = v;
    }
  }
  return [low, high];
}

/** Every triangle of an obstacle gets corners of its own, smooth where its surface is. */
function obstacleCorners(positions, triangles, vertices) {
  const smooth = normals(positions, triangles, vertices);
  const corners = new Float32Array(3 * triangles.length);
  const sum = new Float32Array(3 * triangles.length);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
    const px = positions[b] - positions[a], py = positions[b + 1] - positions[a + 1], pz = positions[b + 2] - positions[a + 2];
    const qx = positions[c] - positions[a], qy = positions[c + 1] - positions[a + 1], qz = positions[c + 2] - positions[a + 2];
    let flat = [py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx];
    const area = Math.hypot(...flat) || 1;
    flat = flat.map((v) => v / area);
    for (let k = 0; k < 3; k++) {
      const v = 3 * triangles[t + k];
      const at = 3 * (t + k);
      const length = Math.hypot(smooth[v], smooth[v + 1], smooth[v + 2]) || 1;
      const cosine = (smooth[v] * flat[0] + smooth[v + 1] * flat[1] + smooth[v + 2] * flat[2]) / length;
      for (let i = 0; i < 3; i++) {
        corners[at + i] = positions[v + i];
        sum[at + i] = cosine > SMOOTH ? smooth[v + i] / length : flat[i];
      }
    }
  }
  return { corners, normals: packed(sum, triangles.length) };
}

async function frame({ layer, url, number, epoch }) {
  const buffer = await fetched(url);
  const head = new Uint32Array(buffer, 0, 8);
  if (head[0] !== FRAME) throw new Error("this is no frame");
  const [, vertices, sent, low, high, meshLow, meshHigh] = head;
  const key = `${layer}${epoch}/${meshHigh.toString(16)}-${meshLow.toString(16)}`;
  let known = meshes.get(key);
  let shown = null;
  if (!known) {
    const found = await mesh(key, `${layer}mesh/${number}`);
    [known, shown] = [found.made, found.shown];
  }
  if (vertices !== known.vertices) throw new Error("this frame is of another mesh");
  const begin = performance.now();
  const positions = new Float32Array(buffer, 32, 3 * vertices);
  const own = positions.slice();
  const result = {
    positions: own,
    normals: packed(normals(own, known.cloth, vertices), vertices),
    bounds: bounds(own),
    meshKey: key,
    mesh: shown,
    obstacleHash: high.toString(16).padStart(8, "0") + low.toString(16).padStart(8, "0"),
  };
  const moved = [own.buffer, result.normals.buffer];
  if (shown) moved.push(shown.triangles.buffer, shown.piece.buffer);
  if (sent > 0 && sent === known.obstacleVertices) {
    const points = new Float32Array(buffer, 32 + 12 * vertices, 3 * sent);
    result.obstacle = obstacleCorners(points, known.obstacle, sent);
    result.obstacle.bounds = bounds(points);
    moved.push(result.obstacle.corners.buffer, result.obstacle.normals.buffer);
  }
  result.ms = performance.now() - begin;
  return [result, moved];
}

self.onmessage = async ({ data }) => {
  const { id, what } = data;
  try {
    if (what === "frame") {
      const [result, moved] = await frame(data);
      self.postMessage({ id, result }, moved);
    } else {
      const buffer = await fetched(data.url);
      self.postMessage({ id, result: buffer }, [buffer]);
    }
  } catch (error) {
    self.postMessage({ id, error: error.message });
  }
};
