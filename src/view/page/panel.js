// The panel on the right: what the run is, colors, what is shown. And small helpers to make elements.

import { MAPS, category, css, gradient } from "./colors.js";

/** Empties a canvas at the size that the page shows it at. `pen` draws on it in CSS pixels, `w` x `h` of them. */
export function blank(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = w * ratio;
  canvas.height = h * ratio;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  return { pen, w, h };
}

/** An element with attributes and children. */
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (typeof value === "boolean") made.toggleAttribute(key, value);
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

/** Shows a text beside the pointer, or with null none. */
export function tip(text, event) {
  const box = document.getElementById("tip");
  box.hidden = !text;
  if (!text) return;
  box.textContent = text;
  box.style.left = `${Math.min(event.clientX + 14, innerWidth - box.offsetWidth - 8)}px`;
  box.style.top = `${Math.max(4, event.clientY - box.offsetHeight - 8)}px`;
}

export const MODES = [
  ["fabric", "Fabric"], ["piece", "Piece"], ["rank", "Rank"], ["strain", "Strain"], ["contact", "Contact"],
  ["height", "Height"], ["segment", "Segment"],
];

const count = (n) => (n === undefined ? "\u2013" : Math.round(n).toLocaleString("en"));
const rows = (list) => list.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]);

function seconds(s) {
  if (!(s >= 0)) return "\u2013";
  if (s < 90) return `${s.toFixed(s < 10 ? 1 : 0)} s`;
  return s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`;
}

const milliseconds = (s) => `${s < 0.1 ? (1e3 * s).toPrecision(3) : Math.round(1e3 * s).toLocaleString("en")} ms`;

/** Status of a run as a word and a sentence. */
export function status(run) {
  if (run.gone) return ["gone", "the run directory is gone; what was loaded stays on the screen"];
  const text = run.report?.header.status;
  if (!text) return ["waiting", "no report yet"];
  if (text.startsWith("failed")) return ["failed", text];
  if (text === "running" && run.silent > 60) return ["running", `no news for ${seconds(run.silent)}`];
  return [text, text];
}

export class Panel {
  constructor(app, root) {
    this.app = app;
    this.about = element("div");
    this.modes = element("div", { class: "modes" });
    this.why = element("p", { class: "why", hidden: true });
    this.pieces = element("div", { class: "rows" });
    this.looks = element("div");
    this.distance = element("div");
    root.append(
      this.about, element("h2", {}, "Color by"), this.modes, this.why, this.distance, element("h2", {}, "Show"),
      this.pieces, this.looks,
    );
    for (const [mode, name] of MODES) {
      const button = element("button", { "data-mode": mode }, name);
      button.onclick = () => app.setMode(mode);
      this.modes.append(button);
    }
    const option = (name, text, on) => {
      const box = element("input", { type: "checkbox" });
      box.checked = on;
      box.onchange = () => app.setOption(name, box.checked);
      return element("label", {}, box, text);
    };
    const fit = element("button", { id: "fit", title: "Show everything (F)" }, "Fit view");
    fit.onclick = () => app.fit();
    this.looks.append(
      option("shadows", "Shadows", app.options.shadows), option("wire", "Edges of triangles", app.options.wire), fit,
    );
    fit.style.marginTop = "8px";
  }

  update() {
    const { app } = this;
    const splits = app.runs.some((run) => (run.report?.split || 1) > 1);
    for (const button of this.modes.children) {
      button.classList.toggle("on", button.dataset.mode === app.mode);
      if (button.dataset.mode === "segment") {
        button.disabled = !splits;
        button.title = splits ? "" : "this run is not split in time (loomtree run --segments)";
      }
    }
    this.why.hidden = !app.why;
    this.why.textContent = app.why || "";
    this.updateAbout();
    this.updatePieces();
  }

  updateAbout() {
    const columns = this.app.runs.map((run) => {
      const header = run.report?.header;
      const frames = `${Math.max(0, run.lastFrame)} of ${run.wanted}`;
      if (!header) return [["scene", "no report yet"]];
      const now = run.live ? Date.now() / 1e3 : header.ended_unix_s || Date.now() / 1e3;
      const passed = now - header.started_unix_s;
      const totals = run.report.steps.total_s;
      const mean = totals.reduce((a, b) => a + b, 0) / Math.max(1, totals.length);
      const left = run.live && totals.length ? mean * (run.wanted * header.steps_per_frame - totals.length) : 0;
      const list = [
        ["scene", header.scene || "\u2013"],
        ["triangles", count(header.triangles)],
        ["workers", `${header.workers} \u00d7 ${header.executor || "?"}`],
        ["frames", frames],
        ["steps", `${header.steps_per_frame} \u00d7 ${Number((1e3 * header.step_s).toPrecision(3))} ms`],
        ["mean step", totals.length ? milliseconds(mean) : "\u2013"],
        [run.live ? "running for" : "took", seconds(passed)],
      ];
      if (run.live) list.push(["left, about", seconds(Math.max(0, left))]);
      if ((run.report.split || 1) > 1) list.push(["segments", `${run.report.split}`]);
      return list;
    });
    if (columns.length === 1) {
      this.about.replaceChildren(element("h2", {}, "Run"), element("dl", {}, ...rows(columns[0])));
      return;
    }
    const names = [...new Set(columns.flat().map(([name]) => name))];
    const cell = (column, name) => element("td", {}, column.find(([key]) => key === name)?.[1] ?? "");
    const line = (name) => element("tr", {}, element("td", {}, name), ...columns.map((column) => cell(column, name)));
    const head = element("tr", {}, element("th", {}), ...columns.map((_, i) => element("th", {}, "AB"[i])));
    this.about.replaceChildren(element("h2", {}, "Runs"), element("table", { class: "runs" }, head, ...names.map(line)));
  }

  /** Boxes for pieces and obstacles; made anew only when there are others. */
  updatePieces() {
    const { app } = this;
    const pieces = app.pieceNames();
    const obstacles = app.obstacleNames();
    const key = JSON.stringify([pieces, obstacles, app.mode === "piece", [...app.hidden.piece, "-", ...app.hidden.obstacle]]);
    if (key === this.piecesKey) return;
    this.piecesKey = key;
    const box = (name, kind, i, color) => {
      const input = element("input", { type: "checkbox", "data-kind": kind, "data-number": String(i) });
      input.checked = !app.hidden[kind].has(i);
      input.onchange = () => app.hide(kind, i, !input.checked);
      const key = element("i");
      if (color) key.style.background = color;
      return element("label", { class: "key" }, input, ...(color ? [key] : []), name);
    };
    const colored = app.mode === "piece" && pieces.length > 1;
    this.pieces.replaceChildren(
      ...pieces.map((name, i) => box(name, "piece", i, colored ? css(category(i)) : null)),
      ...obstacles.map((name, i) => box(name, "obstacle", i, null)),
    );
  }

  /** Figures of `compare` for the frame, when two runs are shown. */
  showDistance(found) {
    if (!found) return this.distance.replaceChildren();
    const parts = [element("h2", {}, "B from A at this frame")];
    if (typeof found === "string") parts.push(element("p", { class: "quiet" }, found));
    else {
      const mm = (m) => `${(1e3 * m).toPrecision(3)} mm`;
      const share = (v) => (v === null ? "\u2013" : v.toPrecision(3));
      parts.push(element("dl", { id: "distance" }, ...rows([
        ["bits", found.equal_bits ? "equal" : "differ"],
        ["rms", mm(found.rms_m)],
        ["largest", `${mm(found.max_m)} at ${found.max_vertex}`],
        ["rms, aligned", mm(found.aligned_rms_m)],
        ["Eq. 17, angles", share(found.eq17_theta)],
        ["Eq. 17, curvature", share(found.eq17_curvature)],
      ])));
    }
    this.distance.replaceChildren(...parts);
  }
}

/** Fills the legend for a mode; hides it where there is nothing to explain. */
export function legend(app) {
  const root = document.getElementById("legend");
  const ramp = (map, title, from, to) => {
    const bar = element("div", { class: "ramp" });
    bar.style.background = gradient(map);
    return [title, bar, element("div", { class: "ends" }, element("span", {}, from), element("span", {}, to))];
  };
  const keys = (names) => {
    const shown = names.slice(0, 24).map((name, i) => {
      const swatch = element("i");
      swatch.style.background = css(category(i));
      return element("span", { class: "key" }, swatch, name);
    });
    if (names.length > 24) shown.push(element("span", { class: "quiet" }, `and ${names.length - 24} more`));
    return [element("div", { class: "keys" }, ...shown)];
  };
  const percent = (v) => `${v > 0 ? "+" : ""}${Number((100 * v).toPrecision(2))} %`;
  const meters = (v) => `${v.toPrecision(3)} m`;
  const range = app.range[app.mode];
  const { mode } = app;
  let parts = null;
  if (mode === "strain" && range) parts = ramp("strain", "strain of the triangles at a vertex", percent(range[0]), percent(range[1]));
  if (mode === "contact") {
    const mm = app.runs[app.active].names?.thickness_m;
    parts = ramp("contact", "gap to the nearest contact", mm ? `${1e3 * mm} mm or more` : "thickness", "touching");
  }
  if (mode === "height" && range) parts = ramp("height", "height", meters(range[0]), meters(range[1]));
  if (mode === "rank") {
    const ranks = app.runs[app.active].names?.ranks || 0;
    if (ranks) parts = keys(Array.from({ length: ranks }, (_, i) => `rank ${i}`));
  }
  if (mode === "piece" && app.pieceNames().length > 1) parts = keys(app.pieceNames());
  if (mode === "segment") {
    const run = app.runs[app.active];
    const cuts = run.report?.cuts || [];
    parts = keys(cuts.map((cut, i) => `segment ${i} from frame ${Math.floor(cut / (run.report.header.steps_per_frame || 1))}`));
    if (cuts.length === 0) parts = ["coarse run: not cut yet"];
  }
  root.hidden = !parts;
  if (parts) root.replaceChildren(...parts);
}

export { MAPS };
