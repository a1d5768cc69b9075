// A run as the page knows it: what the server tells again and again, and frames that the worker has decoded.

/** Decoded frames that a run may keep, bytes. */
const KEPT = 384 * 2 ** 20;
/** Milliseconds after which something that failed is tried again. */
const AGAIN = 1500;

const inRanges = (ranges, n) => ranges.some(([from, to]) => n >= from && n <= to);
const lastOf = (ranges) => (ranges.length ? ranges[ranges.length - 1][1] : -1);

class Layer {
  constructor(prefix) {
    this.prefix = prefix;
    this.frames = new Map();
    this.pending = new Set();
    this.failed = new Map();
    /** By key; `mesh` is the one that came last. */
    this.meshes = new Map();
    this.mesh = null;
    this.obstacles = new Map();
    this.bytes = 0;
  }
}

export class Run {
  constructor(index, changed) {
    this.index = index;
    this.changed = changed;
    this.base = `run/${index}/`;
    this.worker = new Worker("decode.js");
    this.calls = new Map();
    this.nextCall = 0;
    this.worker.onmessage = ({ data }) => {
      const { resolve, reject } = this.calls.get(data.id);
      this.calls.delete(data.id);
      if (data.error === undefined) resolve(data.result);
      else reject(new Error(data.error));
    };
    this.path = "";
    this.generation = -1;
    this.fineRanges = [];
    this.coarseRanges = [];
    this.report = null;
    this.version = "";
    this.gone = false;
    this.names = null;
    this.decodeMs = 0;
    this.reset();
  }

  reset() {
    this.fine = new Layer(this.base);
    this.coarse = new Layer(`${this.base}coarse/`);
    this.values = new Map();
    this.names = null;
    this.namesPending = false;
    this.namesError = null;
    /** Counts what is shown anew, so that answers of before are dropped. */
    this.epoch = (this.epoch || 0) + 1;
  }

  call(message) {
    return new Promise((resolve, reject) => {
      const id = this.nextCall++;
      this.calls.set(id, { resolve, reject });
      this.worker.postMessage({ id, ...message });
    });
  }

  /** Asks the server once. Returns whether something has changed. */
  async poll() {
    const response = await fetch(`${this.base}state?have=${encodeURIComponent(this.version)}`);
    if (!response.ok) throw new Error(`the server answers ${response.status}`);
    const state = await response.json();
    const before = JSON.stringify([this.fineRanges, this.coarseRanges, this.version, this.gone, this.steered]);
    this.path = state.path;
    this.silent = state.silent_s;
    this.steered = Boolean(state.steered);
    const isGone = state.frames.length === 0 && state.coarse.length === 0 && !state.version;
    if (isGone && this.lastFrame >= 0) {
      // What was loaded stays on the screen until a run is there again.
      this.gone = true;
    } else {
      if (this.generation >= 0 && state.generation !== this.generation) {
        this.reset();
        this.report = null;
      }
      this.gone = false;
      this.generation = state.generation;
      this.fineRanges = state.frames;
      this.coarseRanges = state.coarse;
      this.version = state.version || "";
      if (state.report) this.report = state.report;
    }
    return before !== JSON.stringify([this.fineRanges, this.coarseRanges, this.version, this.gone, this.steered]);
  }

  get live() {
    return !this.gone && (!this.report || this.report.header.status === "running");
  }

  /** The last frame that could be shown; -1 without any. */
  get lastFrame() {
    return Math.max(lastOf(this.fineRanges), lastOf(this.coarseRanges));
  }

  get wanted() {
    return this.report?.header.frames_wanted ?? this.lastFrame;
  }

  /** What there is for a frame: "fine", "coarse", or null. */
  has(n) {
    if (inRanges(this.fineRanges, n)) return "fine";
    return inRanges(this.coarseRanges, n) ? "coarse" : null;
  }

  /** The frame to show for n: itself, or the newest before it. */
  nearest(n) {
    const below = (ranges) => ranges.reduce((best, [from, to]) => (from <= n ? Math.max(best, Math.min(n, to)) : best), -1);
    return Math.max(below(this.fineRanges), below(this.coarseRanges));
  }

  /** The decoded frame, or null; asks for it in the latter case. */
  get(n) {
    const kind = this.has(n);
    if (!kind) return null;
    const layer = this[kind];
    const frame = layer.frames.get(n);
    if (frame) {
      // The most recently used one is the last.
      layer.frames.delete(n);
      layer.frames.set(n, frame);
      return frame;
    }
    this.load(layer, n);
    return null;
  }

  async load(layer, n) {
    if (this.gone || layer.pending.has(n) || performance.now() < (layer.failed.get(n) || 0)) return;
    const { epoch } = this;
    layer.pending.add(n);
    try {
      const have = [...layer.obstacles.keys()].pop();
      const query = have ? `?obstacles=${have}` : "";
      const url = `${layer.prefix}frame/${n}${query}`;
      const frame = await this.call({ what: "frame", layer: layer.prefix, url, number: n, epoch });
      if (epoch !== this.epoch) return;
      if (frame.mesh && !layer.meshes.has(frame.meshKey)) {
        layer.meshes.set(frame.meshKey, frame.mesh);
        layer.mesh = frame.mesh;
        layer.waiting?.forEach((go) => go());
        layer.waiting = null;
      }
      // Two frames of a new mesh may have asked for it at once; the worker sends it with the first answer.
      while (!layer.meshes.has(frame.meshKey)) await new Promise((go) => (layer.waiting ||= []).push(go));
      frame.mesh = layer.meshes.get(frame.meshKey);
      if (frame.obstacle) {
        // Others than the last one are held by the frames that they belong to.
        layer.obstacles.clear();
        layer.obstacles.set(frame.obstacleHash, frame.obstacle);
      } else {
        frame.obstacle = layer.obstacles.get(frame.obstacleHash) || null;
      }
      frame.number = n;
      frame.coarse = layer === this.coarse;
      frame.bytes = frame.positions.byteLength + frame.normals.byteLength;
      this.decodeMs = frame.ms;
      layer.frames.set(n, frame);
      layer.bytes += frame.bytes;
      for (const [old, { bytes }] of layer.frames) {
        if (layer.bytes <= KEPT || old === n) break;
        layer.frames.delete(old);
        layer.bytes -= bytes;
      }
      this.changed();
    } catch (error) {
      layer.failed.set(n, performance.now() + AGAIN);
      this.trouble = error.message;
    } finally {
      layer.pending.delete(n);
    }
  }

  /** Names and ranges of pieces and obstacles, once they are known. */
  loadNames() {
    if (this.namesPending || this.fineRanges.length === 0) return;
    this.namesPending = true;
    const { epoch } = this;
    fetch(`${this.base}names`).then((response) => response.json()).then((names) => {
      if (epoch !== this.epoch) return;
      if (names.error) this.namesError = names.error;
      else this.names = names;
      this.changed();
    }).catch(() => {
      this.namesPending = false;
    });
  }

  /** A value per vertex: "rank", "strain" or "contact" of a frame; null until it is there, or a sentence why not. */
  vertexValues(what, n) {
    const key = what === "rank" ? what : `${what}/${n}`;
    const known = this.values.get(key);
    if (known !== undefined) return known;
    const { epoch } = this;
    this.values.set(key, null);
    this.call({ what: "values", url: `${this.base}values/${key}` }).then(
      (buffer) => {
        if (epoch !== this.epoch) return;
        this.values.set(key, new Float32Array(buffer));
        // A few hundred frames of the values last shown.
        while (this.values.size > 240) this.values.delete(this.values.keys().next().value);
        this.changed();
      },
      (error) => {
        if (epoch === this.epoch) this.values.set(key, error.message);
        this.changed();
      },
    );
    return null;
  }

  /** The segment of a split shot that a frame belongs to. */
  segmentOf(n) {
    const cuts = this.report?.cuts || [];
    const step = n * (this.report?.header.steps_per_frame || 1);
    let segment = 0;
    cuts.forEach((cut, i) => {
      if (step > cut) segment = i;
    });
    return segment;
  }

  /** Frames of the shot per second of its time. */
  get framesPerSecond() {
    const header = this.report?.header;
    const length = header ? header.step_s * header.steps_per_frame : 0;
    return length > 0 ? 1 / length : 25;
  }
}
