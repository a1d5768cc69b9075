// One lane per worker for a traced step: what it computed, transferred (by stage) and waited for.

import { ACTIVITY, css } from "./colors.js";
import { element, tip } from "./panel.js";

const ACTIVITIES = ["compute", "transfer", "wait"];
const STAGES = [
  ["collisions", ["proximity", "contacts", "positions", "continuous", "zones"], "#d9785f"],
  ["assembly", ["elements", "index_fill", "value_fill"], "#e9c46a"],
  ["solve", ["solve"], "#5ca4e6"],
  ["other", ["exchange", "advance"], "#8a94a1"],
];

/** Seconds of groups of stages in a step. */
export function groups(stages) {
  return STAGES.map(([name, of, color]) => [name, of.reduce((sum, stage) => sum + (stages[stage] || 0), 0), color]);
}

export class Lanes {
  constructor(app) {
    this.app = app;
    this.root = element("div", { class: "lanes" });
    this.line = element("div", { class: "line" });
    this.canvas = element("canvas");
    this.root.append(this.line, this.canvas);
    this.cache = new Map();
    this.offset = 0;
    this.zoom = [0, 1];
    this.pointer();
  }

  /** The step to show: of those of the frame the one chosen, preferably one that was traced. */
  step() {
    const { app } = this;
    const run = app.runs[app.active];
    const per = run.report?.header.steps_per_frame || 1;
    const last = Math.max(1, app.frame * per);
    const first = Math.max(1, last - per + 1);
    const traced = (run.links?.steps || []).filter((step) => step >= first && step <= last);
    const start = traced.length ? traced[0] : last;
    const step = Math.max(first, Math.min(last, start + this.offset));
    return { run, step, first, last, traced };
  }

  show(frame) {
    if (frame !== this.lastFrame) this.offset = 0;
    this.lastFrame = frame;
    const { run, step, first, last } = this.step();
    const many = this.app.runs.length > 1 ? ` of ${run.path}` : "";
    const button = (text, by, title) => {
      const made = element("button", { title, disabled: step + by < first || step + by > last }, text);
      made.onclick = () => {
        this.offset += by;
        this.show(frame);
      };
      return made;
    };
    const keys = ACTIVITIES.map((name, i) => element("span", { class: "key" }, swatch(css(ACTIVITY[i])), name));
    const key = `${run.index}/${run.epoch}/${run.version}/${step}`;
    const traced = run.links?.steps?.includes(step);
    this.line.replaceChildren(
      button("\u2039", -1, "Step before"), element("span", {}, `step ${step}${many}`), button("\u203a", 1, "Next step"), ...keys,
      this.note = element("span", { class: "quiet" }),
    );
    if (!run.links || !traced) {
      this.data = null;
      this.note.textContent = run.linksError || (run.links
        ? `not traced (traced: ${span(run.links.steps)}; --trace-steps N keeps more): of each stage the slowest rank, from report.json`
        : "");
      return this.stages(run, step);
    }
    const known = this.cache.get(key);
    if (known) {
      if (known !== "asked") this.lanes(known);
      return;
    }
    this.cache.set(key, "asked");
    while (this.cache.size > 40) this.cache.delete(this.cache.keys().next().value);
    fetch(`${run.base}lanes/${step}`).then((response) => response.json()).then((lanes) => {
      if (lanes.error) throw new Error(lanes.error);
      this.cache.set(key, lanes);
      if (this.root.isConnected && this.step().step === step) this.lanes(lanes);
    }).catch((error) => {
      this.cache.delete(key);
      this.note.textContent = error.message;
    });
  }

  pen() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    return pen;
  }

  lanes(data) {
    this.data = data;
    const times = [0, 0, 0];
    data.lanes.forEach((lane) => {
      for (let i = 0; i < lane.length; i += 6) times[lane[i + 2]] += lane[i + 1];
    });
    const whole = times.reduce((a, b) => a + b, 0) || 1;
    const shares = times.map((t, i) => `${Math.round((100 * t) / whole)} % ${ACTIVITIES[i]}`).join(", ");
    this.note.textContent = `${(data.length_us / 1e3).toFixed(2)} ms, ${shares} (wheel: zoom, drag: move)`;
    const pen = this.pen();
    const [w, h] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const left = 58;
    const rows = data.lanes.length;
    const row = Math.min(30, (h - 18) / rows);
    const [from, to] = this.zoom.map((z) => z * data.length_us);
    const x = (us) => left + ((w - left - 4) * (us - from)) / (to - from);
    this.place = { left, row, x, from, to, w };
    data.lanes.forEach((lane, rank) => {
      const y = 2 + rank * row;
      pen.fillStyle = "#9aa4b0";
      pen.fillText(`rank ${rank}`, 4, y + row / 2);
      pen.fillStyle = "#1a1f26";
      pen.fillRect(left, y, w - left - 4, row - 3);
      for (let i = 0; i < lane.length; i += 6) {
        const a = Math.max(left, x(lane[i]));
        const b = Math.min(w - 4, x(lane[i] + lane[i + 1]));
        if (b < left || a > w - 4) continue;
        const color = ACTIVITY[lane[i + 2]];
        // Stages of transfers differ in lightness.
        const shade = lane[i + 2] === 1 ? 1 - 0.13 * (lane[i + 4] % 4) : 1;
        pen.fillStyle = css(color.map((c) => c * shade));
        pen.fillRect(a, y, Math.max(0.6, b - a - 0.3), row - 3);
        const text = label(data, lane, i);
        if (b - a > 6.2 * text.length) {
          pen.fillStyle = "#10141a";
          pen.fillText(text, a + 4, y + (row - 3) / 2);
        }
      }
    });
    pen.fillStyle = "#8c96a3";
    const ticks = 6;
    for (let i = 0; i <= ticks; i++) {
      const us = from + ((to - from) * i) / ticks;
      pen.textAlign = i === 0 ? "left" : i === ticks ? "right" : "center";
      pen.fillText(`${(us / 1e3).toFixed(to - from < 2000 ? 3 : 2)} ms`, x(us), rows * row + 10);
    }
  }

  /** Without a trace: the stages of the step side by side, as the report has them. */
  stages(run, step) {
    const steps = run.report?.steps;
    const at = steps ? steps.step.indexOf(step) : -1;
    const pen = this.pen();
    if (at < 0) return;
    const stages = steps.stages[at];
    const all = groups(stages).filter(([, seconds]) => seconds > 0);
    const whole = all.reduce((sum, [, seconds]) => sum + seconds, 0) || 1;
    const w = this.canvas.clientWidth - 8;
    let left = 4;
    all.forEach(([name, seconds, color]) => {
      const width = (w * seconds) / whole;
      pen.fillStyle = color;
      pen.fillRect(left, 6, Math.max(1, width - 1), 30);
      const text = `${name} ${(1e3 * seconds).toFixed(2)} ms`;
      if (width > 6.2 * text.length) {
        pen.fillStyle = "#10141a";
        pen.fillText(text, left + 6, 21);
      }
      left += width;
    });
    pen.fillStyle = "#8c96a3";
    pen.fillText(`whole step ${(1e3 * stages.total).toFixed(2)} ms`, 4, 52);
  }

  pointer() {
    const { canvas } = this;
    const under = (event) => {
      const box = canvas.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    canvas.addEventListener("wheel", (event) => {
      if (!this.data) return;
      event.preventDefault();
      const [px] = under(event);
      const [from, to] = this.zoom;
      const share = (px - this.place.left) / Math.max(1, this.place.w - this.place.left - 4);
      const at = from + Math.max(0, Math.min(1, share)) * (to - from);
      const scale = Math.exp(event.deltaY / 300);
      this.zoom = [Math.max(0, at - (at - from) * scale), Math.min(1, at + (to - at) * scale)];
      this.lanes(this.data);
    }, { passive: false });
    canvas.addEventListener("dblclick", () => {
      this.zoom = [0, 1];
      if (this.data) this.lanes(this.data);
    });
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointerleave", () => tip(null));
    canvas.addEventListener("pointermove", (event) => {
      if (!this.data) return;
      const [px, py] = under(event);
      if (event.buttons & 1) {
        const [from, to] = this.zoom;
        const by = (-event.movementX / Math.max(1, this.place.w - this.place.left)) * (to - from);
        const kept = Math.max(-from, Math.min(1 - to, by));
        this.zoom = [from + kept, to + kept];
        this.lanes(this.data);
        return;
      }
      const lane = this.data.lanes[Math.floor((py - 2) / this.place.row)];
      const us = this.place.from + ((px - this.place.left) / (this.place.w - this.place.left - 4)) * (this.place.to - this.place.from);
      for (let i = 0; lane && i < lane.length; i += 6) {
        if (us >= lane[i] && us <= lane[i] + lane[i + 1]) {
          const text = `${label(this.data, lane, i)}: ${ACTIVITIES[lane[i + 2]]}, ${lane[i + 1].toFixed(1)} \u00b5s`;
          return tip(text, event);
        }
      }
      tip(null);
    });
  }
}

function label(data, lane, i) {
  const stage = lane[i + 4] > 0 && lane[i + 2] > 0 ? ` (stage ${lane[i + 4]} from ${lane[i + 5]})` : "";
  return data.names[lane[i + 3]] + stage;
}

function swatch(color) {
  const made = element("i");
  made.style.background = color;
  return made;
}

function span(numbers) {
  return numbers.length > 1 ? `${numbers[0]} to ${numbers[numbers.length - 1]}` : `${numbers[0] ?? "none"}`;
}
