// The page: keeps runs, frame, colors and camera together, and draws when something has changed.

import { Camera } from "./camera.js";
import { category } from "./colors.js";
import { Dock } from "./dock.js";
import { MODE, Renderer } from "./gl.js";
import { Panel, element, legend, status } from "./panel.js";
import { Run } from "./run.js";
import { Scrub } from "./scrub.js";

const byId = (id) => document.getElementById(id);
const BACKGROUND = [0.165, 0.19, 0.225];
/** Milliseconds between two questions about a run that goes on, and about one that does not. */
const ASK = [400, 3000];
/** A picture that takes longer than this while things move is drawn with fewer pixels. */
const SLOW_MS = 45;
const AHEAD = 4;

/** What a run shows: its surfaces on the device and the frame that is in them. */
class Shown {
  constructor(renderer) {
    this.renderer = renderer;
    this.layers = {};
    this.frame = null;
  }

  clear() {
    Object.values(this.layers).forEach(({ cloth, obstacle }) => {
      cloth.free();
      obstacle.free();
    });
    this.layers = {};
    this.frame = null;
  }

  /** The layer of a frame, made when it is first shown. */
  layer(run, frame, app) {
    const name = frame.coarse ? "coarse" : "fine";
    const { mesh } = frame;
    if (this.layers[name] && this.layers[name].mesh !== mesh) {
      // A run that sews goes on with another mesh.
      this.layers[name].cloth.free();
      this.layers[name].obstacle.free();
      delete this.layers[name];
    }
    if (!this.layers[name]) {
      const cloth = this.renderer.surface();
      const made = { cloth, obstacle: this.renderer.surface(), mesh, hidden: null, color: null, obstacleHash: null };
      cloth.positions(frame.positions);
      cloth.category(new Uint16Array(mesh.vertices));
      cloth.value(new Float32Array(mesh.vertices));
      this.layers[name] = made;
    }
    const layer = this.layers[name];
    const hidden = [...app.hidden.piece].sort().join();
    if (layer.hidden !== hidden) {
      layer.hidden = hidden;
      layer.cloth.triangles(visible(layer.mesh, app.pieceOf(run, layer.mesh), app.hidden.piece));
    }
    return layer;
  }
}

function visible(mesh, piece, hidden) {
  if (hidden.size === 0) return mesh.triangles;
  const kept = [];
  for (let t = 0; t < mesh.triangles.length; t += 3) {
    if (!hidden.has(piece[mesh.triangles[t]])) kept.push(mesh.triangles[t], mesh.triangles[t + 1], mesh.triangles[t + 2]);
  }
  return new Uint32Array(kept);
}

class App {
  constructor(runs) {
    this.runs = Array.from({ length: runs }, (_, i) => new Run(i, () => (this.dirty = this.news = true)));
    this.renderer = new Renderer(byId("view"));
    this.shown = this.runs.map(() => new Shown(this.renderer));
    this.camera = new Camera();
    this.frame = 0;
    this.active = 0;
    this.playing = false;
    this.follow = true;
    this.speed = 1;
    this.mode = "fabric";
    this.range = {};
    this.hidden = { piece: new Set(), obstacle: new Set() };
    this.options = { shadows: true, wire: false, background: BACKGROUND };
    this.distances = new Map();
    this.box = null;
    this.touched = false;
    this.scale = 1;
    this.dirty = this.news = true;
    this.rate = { pictures: 0, since: performance.now(), last: 0, drawMs: 0 };
    this.panel = new Panel(this, byId("panel"));
    this.dock = new Dock(this, byId("dock"));
    this.scrub = new Scrub(byId("scrub"), (n) => this.seek(n));
    this.camera.attach(byId("view"), () => {
      this.touched = true;
      this.moving = performance.now();
      this.dirty = true;
    });
    this.buttons();
    new ResizeObserver(() => {
      this.dirty = this.news = true;
      this.dock.show(true);
    }).observe(document.body);
    this.runs.forEach((run) => this.ask(run));
    requestAnimationFrame((now) => this.tick(now));
  }

  get lastFrame() {
    return Math.max(...this.runs.map((run) => run.lastFrame));
  }

  async ask(run) {
    try {
      if (await run.poll()) this.heard(run);
      this.lost = false;
    } catch (error) {
      this.lost = true;
    }
    if (this.wasLost !== this.lost) {
      this.wasLost = this.lost;
      this.dirty = this.news = true;
    }
    const wait = ASK[run.live && !document.hidden ? 0 : 1];
    setTimeout(() => this.ask(run), wait);
  }

  /** Something of a run has changed. */
  heard(run) {
    this.dirty = this.news = true;
    const shown = this.shown[run.index];
    if (shown.epoch !== run.epoch) {
      shown.epoch = run.epoch;
      shown.clear();
      this.distances.clear();
      this.box = null;
      this.touched = false;
      this.follow = true;
    }
    const up = run.report?.header.up_axis;
    if (up && !this.touched) this.camera.upAxis = up;
    run.loadNames();
    this.loadLinks(run);
    if (this.follow && !this.playing) this.frame = Math.max(0, this.lastFrame);
    this.dock.layout();
  }

  /** The trace of a run goes on for its first steps only, so it is asked for again when it may have grown. */
  loadLinks(run) {
    const steps = run.report?.steps.step.length || 0;
    if (run.linksAt === `${run.epoch}/${steps}` || run.linksPending || (run.links && run.linksEpoch === run.epoch && run.linksDone)) return;
    run.linksPending = true;
    run.linksAt = `${run.epoch}/${steps}`;
    const { epoch } = run;
    fetch(`${run.base}links`).then((response) => response.json()).then((links) => {
      run.linksPending = false;
      run.linksEpoch = epoch;
      run.linksError = links.error || null;
      const traced = links.steps?.length || 0;
      run.linksDone = traced > 0 && traced === run.links?.steps.length;
      run.links = links.error ? null : links;
      this.news = this.dirty = true;
      this.dock.show(true);
    }).catch(() => {
      run.linksPending = false;
    });
  }

  // ---- what the user asks for ----

  seek(n) {
    const to = Math.max(0, Math.min(Math.max(0, this.lastFrame), n));
    this.follow = to === this.lastFrame;
    this.moveTo(to);
    this.played = null;
  }

  moveTo(n) {
    if (n === this.frame) return;
    this.frame = n;
    this.moving = performance.now();
    this.dirty = this.news = true;
  }

  play(on) {
    this.playing = on;
    this.played = null;
    if (on && this.frame >= this.lastFrame) this.moveTo(0);
    this.follow = false;
    byId("play").innerHTML = on ? "&#x25AE;&#x25AE;" : "&#x25B6;";
    byId("play").classList.toggle("on", on);
    this.dirty = true;
  }

  setMode(mode) {
    this.mode = mode;
    this.dirty = this.news = true;
  }

  setOption(name, on) {
    this.options[name] = on;
    this.dirty = true;
  }

  hide(kind, i, hidden) {
    if (hidden) this.hidden[kind].add(i);
    else this.hidden[kind].delete(i);
    this.dirty = this.news = true;
  }

  activate(i) {
    this.active = i;
    this.dock.layout();
    this.dock.show(true);
    this.dirty = this.news = true;
  }

  fit() {
    this.touched = false;
    this.fitted = null;
    this.dirty = true;
  }

  buttons() {
    byId("first").onclick = () => this.seek(0);
    byId("back").onclick = () => this.seek(this.frame - 1);
    byId("ahead").onclick = () => this.seek(this.frame + 1);
    byId("newest").onclick = () => {
      this.play(false);
      this.seek(this.lastFrame);
    };
    byId("play").onclick = () => this.play(!this.playing);
    byId("speed").onchange = (event) => {
      this.speed = Number(event.target.value);
      this.played = null;
    };
    addEventListener("keydown", (event) => {
      if (event.target.matches("input, select") || event.ctrlKey || event.metaKey || event.altKey) return;
      const keys = {
        " ": () => this.play(!this.playing), ArrowLeft: () => this.seek(this.frame - 1), ArrowRight: () => this.seek(this.frame + 1),
        Home: () => this.seek(0), End: () => byId("newest").click(), f: () => this.fit(), F: () => this.fit(),
      };
      if (!keys[event.key]) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  // ---- names ----

  pieceNames() {
    const run = this.runs[0];
    if (run.names?.pieces.length) return run.names.pieces.map((piece) => piece.name);
    const pieces = (run.fine.mesh || run.coarse.mesh)?.pieces || 1;
    return pieces === 1 ? ["cloth"] : Array.from({ length: Math.min(64, pieces) }, (_, i) => `cloth ${i}`);
  }

  obstacleNames() {
    const run = this.runs[0];
    if (run.names) return run.names.obstacles.map((obstacle) => obstacle.name);
    return (run.fine.mesh || run.coarse.mesh)?.obstacleTriangles ? ["obstacles"] : [];
  }

  /** The piece of every vertex: that of the scene where it is known, else what hangs together. */
  pieceOf(run, mesh) {
    const pieces = run.names?.pieces || [];
    const fits = pieces.length > 0 && pieces[pieces.length - 1].to === mesh.vertices;
    if (!fits || mesh === run.coarse.mesh) return mesh.piece;
    if (!mesh.named) {
      mesh.named = new Uint16Array(mesh.vertices);
      pieces.forEach(({ from, to }, i) => mesh.named.fill(i, from, to));
    }
    return mesh.named;
  }

  // ---- drawing ----

  tick(now) {
    requestAnimationFrame((next) => this.tick(next));
    this.advance(now);
    if (!this.dirty) return this.settle(now);
    this.dirty = false;
    const begin = performance.now();
    const views = this.runs.map((run, i) => this.prepare(run, this.shown[i])).filter((view) => view);
    this.place();
    this.renderer.resize(this.scale * Math.min(2, window.devicePixelRatio || 1));
    views.forEach((view) => (view.box = this.shadowBox(view.frame)));
    this.renderer.draw(views, this.camera, this.options);
    this.dock.sheets.Live.mark();
    this.rate.drawMs = performance.now() - begin;
    this.count(now);
    if (this.news) {
      this.news = false;
      this.around();
    }
  }

  /** Play: the frame that is due, if it is there. */
  advance(now) {
    if (!this.playing) return;
    const fps = this.runs[0].framesPerSecond * this.speed;
    if (!this.played) this.played = [now, this.frame];
    const [since, from] = this.played;
    let due = from + Math.floor(((now - since) / 1000) * fps);
    const last = this.lastFrame;
    if (due > last) {
      const live = this.runs.some((run) => run.live);
      due = live || last === 0 ? last : due % (last + 1);
      this.played = [now, due];
    }
    for (let k = 1; k <= AHEAD; k++) this.runs.forEach((run) => run.get((this.frame + k) % (last + 1)));
    if (due === this.frame) return;
    // Frames that come late are waited for, so that none is jumped over for long.
    const ready = (n) => this.runs.every((run) => run.has(n) === null || run.get(n));
    if (ready(due)) return this.moveTo(due);
    const next = (this.frame + 1) % (last + 1);
    if (ready(next)) {
      this.moveTo(next);
      this.played = [now, next];
    }
  }

  /** Puts the frame of a run on the device; what is not there yet leaves what was shown before. */
  prepare(run, shown) {
    const n = run.has(this.frame) ? this.frame : run.nearest(this.frame);
    const frame = n >= 0 ? run.get(n) : null;
    if (frame) shown.frame = frame;
    if (!shown.frame) return null;
    const now = shown.frame;
    const layer = shown.layer(run, now, this);
    if (layer.uploaded !== now) {
      layer.uploaded = now;
      layer.cloth.positions(now.positions);
      layer.cloth.normals(now.normals);
      if (now.obstacle && layer.obstacleHash !== now.obstacleHash) {
        layer.obstacleHash = now.obstacleHash;
        layer.obstacle.positions(now.obstacle.corners);
        layer.obstacle.normals(now.obstacle.normals);
      }
    }
    const grown = [now.bounds, ...(this.box ? [this.box] : [])];
    const box = [0, 1].map((end) => [0, 1, 2].map((k) => (end ? Math.max : Math.min)(...grown.map((b) => b[end][k]))));
    if (!this.box || box.flat().some((v, i) => v !== this.box.flat()[i])) this.box = box;
    const view = { cloth: layer.cloth, frame: now, coarse: now.coarse, mode: MODE.plain, map: "height", range: [0, 1] };
    this.color(run, layer, now, view);
    if (now.obstacle) {
      const ranges = run.names ? run.names.obstacles.map(({ from, to }) => [3 * from, 3 * to]) : [[0, now.obstacle.corners.length / 3]];
      const kept = ranges.filter((_, i) => !this.hidden.obstacle.has(i));
      layer.obstacle.only(kept);
      if (kept.length) view.obstacle = layer.obstacle;
    }
    return view;
  }

  /** Sets mode, map, range and the values of a view. */
  color(run, layer, frame, view) {
    const { mode } = this;
    this.why = null;
    const put = (kind, key, make) => {
      if (layer[kind] === key) return;
      layer[kind] = key;
      layer.cloth[kind](make());
    };
    if (mode === "piece") {
      const piece = this.pieceOf(run, layer.mesh);
      put("category", piece === layer.mesh.named ? "named" : "piece", () => piece);
      view.mode = MODE.category;
    } else if (mode === "height") {
      view.mode = MODE.height;
      const axis = this.camera.upAxis === "z" ? 2 : 1;
      this.range.height = view.range = [this.box[0][axis], this.box[1][axis]];
    } else if (mode === "segment") {
      view.mode = MODE.uniform;
      if (!frame.coarse) {
        const color = category(run.segmentOf(frame.number));
        view.colors = [color, color.map((c) => c * 0.8)];
      }
    } else if (mode !== "fabric") {
      if (frame.coarse) {
        this.why = `${mode} is not known of frames of the coarse run`;
        return;
      }
      const values = run.vertexValues(mode, frame.number);
      if (typeof values === "string") this.why = values;
      const last = layer.lastValues?.mode === mode ? layer.lastValues.values : null;
      const use = values instanceof Float32Array && values.length === layer.mesh.vertices ? values : last;
      if (!use) return;
      layer.lastValues = { mode, values: use };
      if (mode === "rank") {
        put("category", "rank", () => Uint16Array.from(use));
        view.mode = MODE.category;
      } else {
        put("value", use, () => use);
        [view.mode, view.map] = [MODE.map, mode];
        view.range = mode === "contact" ? [0, 1] : this.strainRange(use);
      }
    }
  }

  /** A symmetric range that holds nearly all strains, and only grows, so that colors keep their meaning. */
  strainRange(values) {
    const some = [];
    const every = Math.max(1, Math.floor(values.length / 4000));
    for (let i = 0; i < values.length; i += every) some.push(Math.abs(values[i]));
    some.sort((a, b) => a - b);
    const high = some[Math.floor(0.98 * (some.length - 1))] || 0;
    const steps = [0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1];
    const wanted = steps.find((step) => step >= high) || 1;
    const end = Math.max(wanted, this.range.strain?.[1] || 0);
    return (this.range.strain = [-end, end]);
  }

  /** What casts shadows: the cloth, and what of the obstacles is near. */
  shadowBox({ bounds: [low, high] }) {
    const by = 0.3 * Math.hypot(...low.map((v, k) => high[k] - v));
    return [low.map((v) => v - by), high.map((v) => v + by)];
  }

  /** Until somebody turns the camera, it shows all that was seen so far. */
  place() {
    if (!this.box || this.touched) return;
    const { clientWidth: w, clientHeight: h } = byId("view");
    const views = Math.max(1, this.shown.filter((shown) => shown.frame).length);
    const obstacle = this.shown.map((shown) => shown.frame?.obstacle?.bounds).find((bounds) => bounds);
    const key = JSON.stringify([this.box, w, h, views, this.camera.upAxis, Boolean(obstacle)]);
    if (key === this.fitted) return;
    if (!this.fitted) this.face();
    this.fitted = key;
    let [low, high] = this.box;
    if (obstacle) {
      const by = 0.35 * Math.hypot(...low.map((v, k) => high[k] - v));
      const cut = (v, k) => Math.max(this.box[0][k] - by, Math.min(this.box[1][k] + by, v));
      low = low.map((v, k) => Math.min(v, cut(obstacle[0][k], k)));
      high = high.map((v, k) => Math.max(v, cut(obstacle[1][k], k)));
    }
    this.camera.fit([low, high], w / views / h);
  }

  /** Turns the camera to the side that shows most of the cloth, and a little beyond. */
  face() {
    const frame = this.shown.find((shown) => shown.frame)?.frame;
    if (!frame) return;
    const [ahead, side] = this.camera.level;
    const { up } = this.camera;
    let [xx, xy, yy, flat] = [0, 0, 0, 0];
    const every = 4 * Math.max(1, Math.floor(frame.normals.length / 4 / 2000));
    for (let i = 0; i < frame.normals.length; i += every) {
      const n = [0, 1, 2].map((k) => frame.normals[i + k] / 32767);
      const along = (axis) => n[0] * axis[0] + n[1] * axis[1] + n[2] * axis[2];
      const [x, y, z] = [along(ahead), along(side), along(up)];
      xx += x * x;
      xy += x * y;
      yy += y * y;
      flat += z * z;
    }
    this.camera.azimuth = 0.5 * Math.atan2(2 * xy, xx - yy) + 0.45;
    this.camera.elevation = flat > xx + yy ? 0.62 : 0.22;
  }

  /** Pictures a second, and pixels that the machine can afford while things move. */
  count(now) {
    const { rate } = this;
    rate.pictures++;
    const apart = now - rate.last;
    rate.last = now;
    if (apart < 500) rate.mean = rate.mean ? 0.9 * rate.mean + 0.1 * apart : apart;
    const isMoving = now - (this.moving || 0) < 300;
    if (isMoving && rate.mean > SLOW_MS && this.scale > 0.5 && rate.pictures > 8) {
      this.scale = Math.max(0.5, this.scale - 0.125);
      rate.pictures = 0;
    }
    if (isMoving && rate.mean) byId("rate").textContent = `${Math.round(1000 / rate.mean)} pictures/s`;
  }

  /** When nothing moves any more, one picture with all pixels; and figures that can wait. */
  settle(now) {
    const rests = now - (this.moving || 0) > 400;
    if (rests && this.scale < 1 && !this.playing) {
      this.sharp = this.scale;
      this.scale = 1;
      this.dirty = true;
    }
    if (rests && this.runs.length > 1) this.askDistance();
  }

  /** Figures of compare: of the frame that is shown, and then of the others. */
  askDistance() {
    if (this.asking) return;
    const both = (n) => this.runs.slice(0, 2).every((run) => run.has(n) === "fine");
    let n = this.frame;
    if (this.distances.has(n) || !both(n)) {
      for (n = 0; n <= this.lastFrame && (this.distances.has(n) || !both(n)); n++);
      if (n > this.lastFrame) return;
    }
    this.asking = true;
    const of = this.distances;
    fetch(`compare/${n}`).then((response) => response.json()).then((found) => {
      of.set(n, found.error || found);
      this.asking = false;
      if (n === this.frame || this.dock.now === "Distance") this.dirty = this.news = true;
    }).catch(() => {
      this.asking = false;
    });
  }

  /** Everything around the picture. */
  around() {
    this.panel.update();
    this.scrub.draw(this.runs, this.frame);
    legend(this);
    const run = this.runs[0];
    const per = run.framesPerSecond;
    byId("counter").textContent = `${this.frame} / ${Math.max(0, run.wanted)}   ${(this.frame / per).toFixed(2)} s`;
    byId("heads").replaceChildren(...this.runs.map((one, i) => {
      const [word, text] = status(one);
      const bar = element("div", { class: "bar" }, element("div"));
      bar.firstChild.style.width = `${(100 * Math.max(0, one.lastFrame)) / Math.max(1, one.wanted)}%`;
      const letter = this.runs.length > 1 ? [element("b", {}, "AB"[i])] : [];
      const path = element("span", { class: "path", title: one.path }, `\u200e${one.path}`);
      return element("span", { class: "head" }, ...letter, path, element("span", { class: `pill ${word}`, title: text }, word), ...(one.live ? [bar] : []));
    }));
    byId("labels").replaceChildren(...(this.runs.length > 1 || this.shown[0].frame?.coarse || this.late(0) ? this.runs : []).map((one, i) => {
      const frame = this.shown[i].frame;
      const parts = this.runs.length > 1 ? [element("div", { class: "name" }, `${"AB"[i]}  ${one.path}`)] : [];
      if (frame?.coarse) parts.push(element("span", { class: "mark coarse" }, `frame ${frame.number}: coarse run`));
      else if (this.late(i)) parts.push(element("span", { class: "mark" }, `frame ${frame.number}, the newest there is`));
      return element("div", {}, ...parts);
    }));
    this.panel.showDistance(this.runs.length > 1 ? this.distances.get(this.frame) || "being computed" : null);
    const notice = byId("notice");
    const text = this.lost ? "loomtree does not answer any more: it was ended, or it is busy"
      : this.shown.some((shown) => shown.frame) ? (this.runs.find((one) => one.gone) ? status(this.runs.find((one) => one.gone))[1] : "")
        : "waiting for the first frame";
    notice.hidden = !text;
    notice.textContent = text;
    notice.style.top = this.shown.some((shown) => shown.frame) ? "8%" : "46%";
    this.dock.show(false);
  }

  /** Whether a run shows another frame than the one asked for, because that is not there. */
  late(i) {
    const { frame } = this.shown[i];
    return frame && !this.runs[i].has(this.frame) && frame.number !== this.frame;
  }
}

async function start() {
  const notice = byId("notice");
  try {
    const { runs } = await (await fetch("runs")).json();
    window.loomtree = new App(runs);
  } catch (error) {
    notice.hidden = false;
    notice.textContent = error.message;
    throw error;
  }
}

start();
