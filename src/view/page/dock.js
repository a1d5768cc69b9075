// The sheet below: timeline, curves, links and memory, seams, distances of two runs.

import { Curves } from "./curves.js";
import { Lanes } from "./lanes.js";
import { Live } from "./live.js";
import { blank, element } from "./panel.js";

const MB = 2 ** 20;
const mm = (m) => (m === null || m === undefined ? "\u2013" : `${(1e3 * m).toPrecision(3)}`);

/** Bytes between ranks in the traced steps, and memory of every rank. */
class Links {
  constructor(app) {
    this.app = app;
    this.root = element("div", { class: "side" });
  }

  show() {
    const run = this.app.runs[this.app.active];
    const key = `${run.index}/${run.epoch}/${run.version}/${run.links?.steps?.length}`;
    if (key === this.key) return;
    this.key = key;
    this.root.replaceChildren(this.heat(run), this.memory(run));
  }

  heat(run) {
    const bytes = run.links?.bytes_from_to;
    if (!bytes || bytes.length === 0) return element("span", { class: "quiet" }, run.linksError || "no trace");
    const steps = run.links.steps.length;
    const most = Math.max(1, ...bytes.flat());
    const table = element("table", { class: "heat" });
    const cell = (value) => {
      const made = element("td", { title: `${value.toLocaleString("en")} bytes in ${steps} steps` });
      if (value > 0) {
        made.textContent = (value / steps / 1024).toPrecision(3);
        made.style.background = `rgba(92, 164, 230, ${(0.12 + 0.75 * (value / most)).toFixed(2)})`;
      }
      return made;
    };
    table.append(element("tr", {}, element("th", {}, "from \\ to"), ...bytes.map((_, r) => element("th", {}, `${r}`))));
    bytes.forEach((row, from) => table.append(element("tr", {}, element("th", {}, `rank ${from}`), ...row.map(cell))));
    const title = element("div", { class: "quiet" }, `KiB a step between ranks, mean of ${steps} traced steps`);
    return element("div", {}, title, table);
  }

  memory(run) {
    const steps = run.report?.steps;
    if (!steps || steps.step.length === 0) return element("span");
    const most = (lists, rank) => Math.max(0, ...lists.map((list) => list[rank] || 0));
    const ranks = Math.max(...steps.memory.map((list) => list.length));
    const limit = run.report.memory_limit_bytes;
    const head = ["", "device", "collision tables", "resident"].map((name) => element("th", {}, name));
    const table = element("table", {}, element("tr", {}, ...head));
    for (let rank = 0; rank < ranks; rank++) {
      const values = [steps.memory, steps.tables, steps.resident].map((lists) => `${(most(lists, rank) / MB).toFixed(1)} MB`);
      if (limit) values[1] += ` of ${(limit / MB).toFixed(0)}`;
      table.append(element("tr", {}, element("td", {}, `rank ${rank}`), ...values.map((text) => element("td", {}, text))));
    }
    const text = limit ? "largest memory over all steps" : "largest memory over all steps (--memory-limit bounds the tables)";
    return element("div", {}, element("div", { class: "quiet" }, text), table);
  }
}

/** Segments and seams of a shot that is split in time. */
class Seams {
  constructor(app) {
    this.app = app;
    this.root = element("div", { class: "side" });
  }

  show() {
    const run = this.app.runs[this.app.active];
    const { segments = [], seams = [], cuts = [], header } = run.report || {};
    const key = `${run.index}/${run.epoch}/${run.version}`;
    if (key === this.key) return;
    this.key = key;
    const per = header?.steps_per_frame || 1;
    const table = (titles, list) => element("table", {}, element("tr", {}, ...titles.map((t) => element("th", {}, t))), ...list);
    const row = (cells, frame) => {
      const made = element("tr", {}, ...cells.map((text) => element("td", {}, text)));
      if (frame !== undefined) {
        const go = element("button", { title: "Go to the seam" }, "show");
        go.onclick = () => this.app.seek(frame);
        made.append(element("td", {}, go));
      }
      return made;
    };
    const parts = [];
    if (seams.length) {
      parts.push(element("div", {}, element("div", { class: "quiet" }, "Seams; distances and jumps in mm"), table(
        ["before frame", "distance rms", "largest", "met", "jump of a step", "within segments", ""],
        seams.map((seam) => row([
          `${Math.ceil(seam.step / per)}`, mm(seam.distance_rms_m), mm(seam.distance_max_m), seam.met ? "yes" : "no",
          mm(seam.jump_max_m), mm(seam.inner_median_max_m),
        ], Math.round(seam.step / per))),
      )));
    } else if (cuts.length) {
      const text = `cut before the frames ${cuts.slice(1).map((cut) => Math.ceil(cut / per)).join(", ")}; seams are joined at the end`;
      parts.push(element("span", { class: "quiet" }, text));
    } else parts.push(element("span", { class: "quiet" }, "not cut yet: the coarse run is being made"));
    if (segments.length) {
      parts.push(element("div", {}, element("div", { class: "quiet" }, "Segments"), table(
        ["", "steps", "session", "recovery", "hand-over", "busy", "idle", "K"],
        segments.map((s) => row([
          `${s.segment}`, `${s.first_step} to ${s.last_step}`, `${s.session}`, `${s.recovery_steps}`, `${s.handover_steps}`,
          `${s.busy_s.toFixed(1)} s`, `${s.idle_s.toFixed(1)} s`, s.k.toFixed(1),
        ])),
      )));
    }
    this.root.replaceChildren(...parts);
  }
}

/** Rms distance of two runs over the frames; figures come one by one. */
class Distances {
  constructor(app) {
    this.app = app;
    this.root = element("div", { class: "lanes" });
    this.line = element("div", { class: "line quiet" });
    this.canvas = element("canvas");
    this.canvas.onclick = (event) => {
      const box = this.canvas.getBoundingClientRect();
      app.seek(Math.round(((event.clientX - box.left) / box.width) * this.last));
    };
    this.root.append(this.line, this.canvas);
  }

  show() {
    const { app, canvas } = this;
    const found = [...app.distances.entries()].filter(([, d]) => typeof d === "object" && d).sort((a, b) => a[0] - b[0]);
    this.last = Math.max(1, app.lastFrame);
    this.line.textContent = found.length
      ? `rms distance of B from A, largest ${mm(Math.max(...found.map(([, d]) => d.rms_m)))} mm; aligned dashed (${found.length} frames)`
      : "no distance yet";
    const { pen, w, h } = blank(canvas);
    const most = Math.max(1e-12, ...found.map(([, d]) => d.rms_m));
    const line = (value, color, dash) => {
      pen.strokeStyle = color;
      pen.setLineDash(dash);
      pen.beginPath();
      found.forEach(([n, d], i) => {
        const [x, y] = [(w * n) / this.last, h - 4 - ((h - 12) * value(d)) / most];
        if (i) pen.lineTo(x, y);
        else pen.moveTo(x, y);
      });
      pen.stroke();
    };
    line((d) => d.rms_m, "#6cb4ee", []);
    line((d) => d.aligned_rms_m, "#e9c46a", [5, 4]);
    pen.fillStyle = "#ffffffb0";
    pen.fillRect((w * app.frame) / this.last, 0, 1, h);
  }
}

export class Dock {
  constructor(app, root) {
    this.app = app;
    this.root = root;
    this.tabs = root.querySelector("#tabs");
    this.sheet = root.querySelector("#sheet");
    this.sheets = {
      Live: new Live(app), Timeline: new Lanes(app),
      Curves: new Curves(app), "Links and memory": new Links(app), Seams: new Seams(app),
      Distance: new Distances(app),
    };
    this.open("Timeline");
  }

  open(name) {
    this.now = name;
    this.root.classList.remove("closed");
    this.sheet.replaceChildren(this.sheets[name].root);
    this.layout();
    this.show(true);
  }

  /** The tabs that this run has. */
  layout() {
    const { app } = this;
    const split = app.runs.some((run) => (run.report?.split || 1) > 1);
    const steered = app.runs[app.active]?.steered;
    const has = { Seams: split, Distance: app.runs.length > 1, Live: steered };
    const names = Object.keys(this.sheets).filter((name) => has[name] ?? true);
    // Somebody who started a run with --live wants to steer it; once it has ended there is nothing to steer.
    if (steered && !this.wasSteered) {
      this.wasSteered = true;
      return this.open("Live");
    }
    if (!steered && this.now === "Live") return this.open("Timeline");
    const key = JSON.stringify([names, this.now, app.active, app.runs.length, this.root.className]);
    if (key === this.key) return;
    this.key = key;
    const buttons = names.map((name) => {
      const button = element("button", name === this.now ? { class: "on" } : {}, name);
      button.onclick = () => (name === this.now && !this.root.classList.contains("closed") ? this.close() : this.open(name));
      return button;
    });
    const which = app.runs.length > 1 ? app.runs.map((_, i) => {
      const button = element("button", { title: "Figures of this run", ...(i === app.active ? { class: "on" } : {}) }, "AB"[i]);
      button.onclick = () => app.activate(i);
      return button;
    }) : [];
    this.tabs.replaceChildren(...buttons, element("span", { class: "space" }), ...which);
  }

  close() {
    this.root.classList.add("closed");
    this.layout();
    this.app.dirty = true;
  }

  /** Shows the frame; `anew`: draw even what only data changes. */
  show(anew) {
    if (this.root.classList.contains("closed")) return;
    const sheet = this.sheets[this.now];
    if (anew) sheet.key = null;
    sheet.show(this.app.frame);
  }
}
