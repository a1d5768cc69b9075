// The sheet of a run with --live: pause, step, forces, fabrics, pins, seams. Every request goes to the run's socket
// through the server (docs/live.md), and its answer says after which step it acts.

import { element } from "./panel.js";

/** Milliseconds between two questions for the status. */
const ASK = 400;
const FABRICS = ["cotton", "silk", "denim", "wool", "nylon", "membrane"];
/** Farthest that a click may be from a vertex of the border, pixels. */
const NEAR = 40;
const PICKS = ["first end of side A", "other end of side A", "first end of side B", "other end of side B"];

const field = (label, ...inputs) => element("label", { class: "field" }, element("span", {}, label), ...inputs);
const number = (title, value = "") => element("input", { type: "number", step: "any", title, value: String(value) });

/** A button that does something. */
function button(text, title, act, attributes = {}) {
  const made = element("button", { title, ...attributes }, text);
  made.onclick = act;
  return made;
}

export class Live {
  constructor(app) {
    this.app = app;
    this.status = null;
    /** Vertices of the frames that were clicked for a seam; null while none is being made. */
    this.picked = null;
    this.state = element("b", { id: "live-state" });
    this.said = element("span", { id: "live-said", class: "quiet" });
    this.vectors = {};
    this.root = element("div", { class: "live" }, this.head(), this.forces(), this.cloth(), this.lists());
    const canvas = document.getElementById("view");
    canvas.addEventListener("pointerdown", (event) => (this.down = [event.clientX, event.clientY]));
    canvas.addEventListener("click", (event) => this.click(event, canvas));
    this.marks = element("div", { id: "marks" });
    canvas.after(this.marks);
    setInterval(() => this.ask(), ASK);
  }

  get run() {
    return this.app.runs[this.app.active];
  }

  // ---- parts of the sheet ----

  head() {
    const steps = () => {
      const per = this.status?.steps_per_frame || 1;
      return per - ((this.status?.step || 0) % per);
    };
    this.toggle = button("Pause", "Stand still after the step under way, or go on", () => {
      this.send({ do: this.status?.state === "paused" ? "continue" : "pause" });
    }, { id: "live-pause" });
    const name = element("input", { type: "text", value: "saved.toml", title: "Name in the run directory" });
    return element("div", { class: "line" },
      this.toggle,
      button("Step", "Make one step", () => this.send({ do: "step", steps: 1 }), { id: "live-step" }),
      button("Frame", "Make steps up to the next frame", () => this.send({ do: "step", steps: steps() }), {
        id: "live-frame",
      }),
      this.state,
      button("Refine", "Divide every triangle into four", () => this.send({ do: "refine" }), { id: "live-refine" }),
      button("Save as scene", "Write the scene with all changes so far", () => {
        this.send({ do: "save", file: name.value });
      }, { id: "live-save" }),
      name,
      button("Stop", "End the run; it can be resumed", () => this.send({ do: "stop" })),
      this.said,
    );
  }

  vector(name, label, unit, act) {
    const inputs = ["x", "y", "z"].map((axis) => number(`${label}, ${axis}, ${unit}`));
    this.vectors[name] = inputs;
    inputs.forEach((input) => (input.onchange = () => input.classList.add("own")));
    const set = button("Set", `Set ${label.toLowerCase()}`, () => {
      inputs.forEach((input) => input.classList.remove("own"));
      act(inputs.map((input) => Number(input.value)));
    }, { id: `live-${name}` });
    return field(`${label}, ${unit}`, ...inputs, set);
  }

  forces() {
    return element("div", { class: "line" },
      this.vector("gravity", "Gravity", "m/s\u00b2", (v) => this.send({ do: "gravity", gravity_m_s2: v })),
      this.vector("wind", "Wind", "m/s", (v) => this.send({ do: "wind", wind_m_s: v })),
    );
  }

  cloth() {
    this.frictionOf = element("select", { title: "Whose friction" });
    this.friction = number("Coulomb friction coefficient", 0.3);
    this.fabricOf = element("select", { title: "Whose fabric" });
    const asItIs = element("option", { value: "" }, "as it is");
    this.fabric = element("select", { title: "Fabric" }, asItIs, ...FABRICS.map((name) => element("option", {}, name)));
    this.density = number("Density, kg/m\u00b2 (empty: that of the fabric)");
    this.density.placeholder = "kg/m\u00b2";
    const of = (select) => (select.value ? JSON.parse(select.value) : {});
    const setFabric = () => {
      const fabric = this.fabric.value === "" ? {} : { fabric: this.fabric.value };
      const density = this.density.value === "" ? {} : { density_kg_m2: Number(this.density.value) };
      this.send({ do: "fabric", ...fabric, ...density, ...of(this.fabricOf) });
    };
    const setFriction = () => {
      this.send({ do: "friction", friction: Number(this.friction.value), ...of(this.frictionOf) });
    };
    const ofFriction = button("Set", "Set friction", setFriction, { id: "live-friction" });
    const ofFabric = button("Set", "Set the fabric", setFabric, { id: "live-fabric" });
    return element("div", { class: "line" },
      field("Friction", this.frictionOf, this.friction, ofFriction),
      field("Fabric", this.fabricOf, this.fabric, this.density, ofFabric),
    );
  }

  lists() {
    this.pins = element("span", { class: "chips" });
    this.seams = element("span", { class: "chips" });
    this.sides = [0, 1].map((i) => element("select", { title: `Side ${"AB"[i]} of a seam`, id: `live-side-${i}` }));
    this.closeS = number("Seconds until the seams are closed", 0.6);
    const closing = () => (this.closeS.value ? { close_s: Number(this.closeS.value) } : {});
    this.closing = closing;
    const sew = () => {
      const [a, b] = this.sides.map((side) => (side.value ? JSON.parse(side.value) : ""));
      this.send({ do: "sew", a, b, ...closing() });
    };
    const how = "Click the two ends of an edge on the cloth, then those of the other one";
    this.pick = button("Click two edges", how, () => {
      this.picked = this.picked ? null : [];
      this.refresh();
    }, { id: "live-pick" });
    const both = button("Sew", "Sew these two edges", sew, { id: "live-sew" });
    return element("div", { class: "line" },
      field("Pins", this.pins),
      field("Seams", this.seams),
      field("Sew", ...this.sides, "in", this.closeS, "s", both, this.pick),
    );
  }

  // ---- talk with the run ----

  async post(request) {
    const response = await fetch(`${this.run.base}live`, { method: "POST", body: JSON.stringify(request) });
    return response.json();
  }

  async send(request) {
    this.said.textContent = `${request.do} \u2026`;
    try {
      const answer = await this.post(request);
      const where = answer.file ? `: ${answer.file}` : ` acts after step ${answer.step}`;
      this.said.textContent = answer.error || `${request.do}${where}`;
      this.said.classList.toggle("bad", Boolean(answer.error));
    } catch (error) {
      this.said.textContent = error.message;
    }
    this.asked = 0;
    this.ask();
  }

  /** Asks for the status, if the sheet is open. */
  async ask() {
    const { app, run } = this;
    if (app.dock.now !== "Live" || !run.steered || this.asking) return;
    this.asking = true;
    try {
      const answer = await this.post({ do: "status" });
      if (!answer.error && answer.state !== "starting") this.heard(answer);
    } catch (error) {
      // The next question will tell.
    } finally {
      this.asking = false;
    }
  }

  heard(status) {
    const before = this.status;
    this.status = status;
    for (const [name, key] of [["gravity", "gravity_m_s2"], ["wind", "wind_m_s"]]) {
      this.vectors[name].forEach((input, i) => {
        const isOwn = input === document.activeElement || input.classList.contains("own");
        if (!isOwn) input.value = Number(status[key][i].toPrecision(6));
      });
    }
    const what = (of) => JSON.stringify([of?.cloths, of?.obstacles, of?.pins, of?.seams]);
    if (what(before) !== what(status)) this.fillLists(status);
    this.refresh();
  }

  fillLists({ cloths, obstacles, pins, seams }) {
    const option = (value, text) => element("option", { value: value ? JSON.stringify(value) : "" }, text);
    const fill = (select, options) => {
      const { value } = select;
      select.replaceChildren(...options);
      if ([...select.options].some((one) => one.value === value)) select.value = value;
    };
    const ofCloth = cloths.map(({ name, fabric }) => [{ cloth: name }, `${name} (${fabric})`]);
    fill(this.fabricOf, [option(null, "all cloths"), ...ofCloth.map(([value, text]) => option(value, text))]);
    const ofAll = [
      ...cloths.map(({ name, friction }) => [{ cloth: name }, `${name} (${friction})`]),
      ...obstacles.map(({ name, friction }) => [{ obstacle: name }, `${name} (${friction})`]),
    ];
    fill(this.frictionOf, [option(null, "everything"), ...ofAll.map(([value, text]) => option(value, text))]);
    const sideOf = (name, edge) => [{ cloth: name, edge }, `${name}: ${edge}`];
    const edgesOf = ({ name, edges: named }) => (named || []).map((edge) => sideOf(name, edge));
    const edges = cloths.flatMap(edgesOf);
    this.sides.forEach((side) => fill(side, edges.map(([value, text]) => option(value, text))));
    const chip = (text, title, request) => button(text, title, () => this.send(request), { class: "chip" });
    this.pins.replaceChildren(...(pins.length
      ? pins.map(({ name }) => chip(`${name} \u00d7`, `Let the pin ${name} go`, { do: "unpin", pin: name }))
      : [element("span", { class: "quiet" }, "none holds")]));
    this.seams.replaceChildren(...(seams.length
      ? seams.map(({ name }) => chip(`${name} \u00d7`, `Take the seam ${name} out`, { do: "unsew", name }))
      : [element("span", { class: "quiet" }, "none open")]));
  }

  refresh() {
    const { status } = this;
    const paused = status?.state === "paused";
    this.toggle.textContent = paused ? "Continue" : "Pause";
    if (status) {
      const size = `${status.triangles.toLocaleString("en")} triangles`;
      const step = `step ${status.step} of ${status.last_step}, ${status.time_s.toFixed(3)} s`;
      this.state.textContent = `${status.state}, ${step}, ${size}`;
    }
    this.pick.classList.toggle("on", this.picked !== null);
    this.pick.textContent = this.picked ? `Click the ${PICKS[this.picked.length]}` : "Click two edges";
    this.app.dirty = true;
  }

  // ---- a seam by clicks ----

  /** The layer and frame on the screen, if clicks on it mean vertices of now. */
  shown() {
    const shown = this.app.shown[this.app.active];
    const layer = shown.frame && shown.layers.fine;
    if (!layer || this.app.runs.length > 1) return null;
    return layer.mesh.vertices === this.status?.vertices ? { layer, frame: shown.frame } : null;
  }

  click(event, canvas) {
    if (!this.picked || this.app.dock.now !== "Live") return;
    // A drag turns the camera.
    if (this.down && Math.hypot(event.clientX - this.down[0], event.clientY - this.down[1]) > 4) return;
    const there = this.shown();
    if (!there) {
      this.said.textContent = "the frame on the screen is not of the mesh of now: show the newest one, or make a frame";
      return;
    }
    const box = canvas.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    const found = this.nearest(there, at, box);
    if (found === null) {
      this.said.textContent = "no vertex of an edge of the cloth is there";
      return;
    }
    this.picked.push(found);
    if (this.picked.length === 4) {
      const [a, b, c, d] = this.picked;
      this.picked = null;
      this.send({ do: "sew", a: { frame_vertices: [a, b] }, b: { frame_vertices: [c, d] }, ...this.closing() });
    }
    this.refresh();
  }

  /** The vertex of the border that is nearest to a point of the canvas. */
  nearest({ layer, frame }, [x, y], box) {
    let best = null;
    for (const v of border(layer.mesh)) {
      const at = this.onScreen(frame.positions, v, box);
      if (!at) continue;
      const apart = Math.hypot(at[0] - x, at[1] - y);
      // Of two at one place the nearer one to the eye.
      const cost = apart + 1e-3 * at[2];
      if (apart <= NEAR && (!best || cost < best.cost)) best = { v, cost };
    }
    return best && best.v;
  }

  /** Where a vertex is on the canvas, pixels, and its distance; null behind the eye. */
  onScreen(positions, v, { width, height }) {
    const { camera } = this.app;
    const point = [positions[3 * v], positions[3 * v + 1], positions[3 * v + 2]];
    const { view, projection } = camera.matrices(width / height);
    const apply = (m, p) => [0, 1, 2, 3].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r] * p[3]);
    const [cx, cy, , w] = apply(projection, apply(view, [...point, 1]));
    return w > 0 ? [((cx / w + 1) / 2) * width, ((1 - cy / w) / 2) * height, w] : null;
  }

  /** Puts a mark on every vertex that was clicked. Called after every picture. */
  mark() {
    const there = this.picked?.length ? this.shown() : null;
    if (!there) {
      if (this.marks.childElementCount) this.marks.replaceChildren();
      return;
    }
    const box = document.getElementById("view").getBoundingClientRect();
    this.marks.replaceChildren(...this.picked.map((v, i) => {
      const at = this.onScreen(there.frame.positions, v, box) || [-99, -99];
      const mark = element("i", {}, i < 2 ? "A" : "B");
      mark.style.left = `${at[0]}px`;
      mark.style.top = `${at[1]}px`;
      return mark;
    }));
  }

  show() {
    this.ask();
  }
}

/** Vertices of edges with one triangle; kept with the mesh. */
function border(mesh) {
  if (mesh.border) return mesh.border;
  const seen = new Map();
  const { triangles } = mesh;
  for (let t = 0; t < triangles.length; t += 3) {
    for (let k = 0; k < 3; k++) {
      const [a, b] = [triangles[t + k], triangles[t + ((k + 1) % 3)]];
      const key = Math.min(a, b) * mesh.vertices + Math.max(a, b);
      seen.set(key, (seen.get(key) || 0) + 1);
    }
  }
  const vertices = new Set();
  for (const [key, count] of seen) {
    if (count === 1) {
      vertices.add(Math.floor(key / mesh.vertices));
      vertices.add(key % mesh.vertices);
    }
  }
  mesh.border = [...vertices];
  return mesh.border;
}
