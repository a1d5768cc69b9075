// Curves over the steps of a run: small charts with a common cursor; a click goes to the frame.

import { category, css } from "./colors.js";
import { groups } from "./lanes.js";
import { blank, element } from "./panel.js";

const MB = 2 ** 20;
const number = (v) => (v === null || v === undefined || !isFinite(v) ? "\u2013"
  : Math.abs(v) >= 1000 ? Math.round(v).toLocaleString("en") : Math.abs(v) >= 10 ? v.toFixed(1) : v.toPrecision(3));

/** Per chart: title, unit, series of values at every step, and how they are drawn. */
function charts(run) {
  const steps = run.report?.steps;
  if (!steps || steps.step.length === 0) return [];
  const one = (values) => [{ values, color: "#6cb4ee" }];
  const perRank = (lists) => {
    const ranks = Math.max(0, ...lists.map((list) => list.length));
    return Array.from({ length: ranks }, (_, r) => ({ values: lists.map((list) => list[r] / MB), color: css(category(r)) }));
  };
  const limit = run.report.memory_limit_bytes;
  const stages = steps.stages.map(groups);
  const times = stages[0].map(([name, , color], g) => ({ name, color, values: stages.map((s) => 1e3 * s[g][1]) }));
  const made = [
    { title: "iterations", series: one(steps.iterations) },
    { title: "step time", unit: "ms", series: times, stacked: true, total: steps.total_s.map((s) => 1e3 * s) },
    { title: "contacts", series: one(steps.contacts) },
    { title: "smallest gap", unit: "mm", series: one(steps.gap_m.map((gap) => (gap === null ? null : 1e3 * gap))) },
    { title: "bytes between ranks", unit: "MB", series: one(steps.bytes.map((b) => b / MB)) },
    { title: "memory per rank", unit: "MB", series: perRank(steps.memory) },
    {
      title: limit ? "collision tables, limit dashed" : "collision tables per rank", unit: "MB", series: perRank(steps.tables),
      limit: limit && limit / MB,
    },
    { title: "impact zones", series: one(steps.zones) },
  ];
  return made.filter(({ series }) => series.some(({ values }) => values.some((v) => v !== null && v > 0)));
}

export class Curves {
  constructor(app) {
    this.app = app;
    this.root = element("div", { class: "charts" });
    this.made = [];
  }

  show() {
    const run = this.app.runs[this.app.active];
    const key = `${run.index}/${run.epoch}/${run.version}/${this.root.clientWidth}`;
    if (key !== this.key) {
      this.key = key;
      this.made = charts(run);
      if (this.made.length === 0) {
        this.root.replaceChildren(element("span", { class: "quiet" }, "no step in report.json yet"));
        return;
      }
      this.root.replaceChildren(...this.made.map((chart) => this.build(chart, run)));
      this.made.forEach((chart) => draw(chart, run.report.steps.step));
    }
    this.cursors(run);
  }

  build(chart, run) {
    chart.canvas = element("canvas");
    chart.cursor = element("div", { class: "cursor" });
    chart.value = element("b");
    const { step } = run.report.steps;
    chart.canvas.onclick = (event) => {
      const box = chart.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left) / box.width;
      const at = step[0] + share * (step[step.length - 1] - step[0]);
      this.app.seek(Math.round(at / (run.report.header.steps_per_frame || 1)));
    };
    const title = element("span", { class: "quiet" }, chart.title);
    return element("div", { class: "chart" }, element("header", {}, title, chart.value), chart.canvas, chart.cursor);
  }

  cursors(run) {
    const { step } = run.report?.steps || { step: [] };
    if (step.length === 0) return;
    const wanted = this.app.frame * (run.report.header.steps_per_frame || 1);
    let at = step.length - 1;
    while (at > 0 && step[at - 1] >= wanted) at--;
    const share = (step[at] - step[0]) / Math.max(1, step[step.length - 1] - step[0]);
    for (const chart of this.made) {
      chart.cursor.style.left = `${share * chart.canvas.clientWidth}px`;
      const values = chart.total ? [chart.total[at]] : chart.series.map(({ values }) => values[at]);
      const text = values.length > 3
        ? `${number(Math.min(...values))} to ${number(Math.max(...values))}`
        : values.map(number).join(" \u00b7 ");
      chart.value.textContent = `${text}${chart.unit ? ` ${chart.unit}` : ""}`;
    }
  }
}

function draw(chart, step) {
  const { canvas } = chart;
  const { pen, w, h } = blank(canvas);
  pen.fillStyle = "#1a1f26";
  pen.fillRect(0, 0, w, h);
  let layers = chart.series;
  if (chart.stacked) {
    const sum = step.map(() => 0);
    layers = chart.series.map((series) => ({ ...series, values: series.values.map((v, i) => (sum[i] += v)) })).reverse();
  }
  let most = chart.limit || 0;
  layers.forEach(({ values }) => values.forEach((v) => {
    if (v > most) most = v;
  }));
  const [first, last] = [step[0], step[step.length - 1]];
  const x = (i) => (last > first ? (w * (step[i] - first)) / (last - first) : w / 2);
  const y = (v) => h - 2 - ((h - 14) * v) / (most || 1);
  for (const { values, color } of layers) {
    pen.strokeStyle = pen.fillStyle = color;
    pen.lineWidth = 1.3;
    pen.beginPath();
    let open = false;
    values.forEach((v, i) => {
      if (v === null || v === undefined) {
        open = false;
        return;
      }
      if (open) pen.lineTo(x(i), y(v));
      else pen.moveTo(x(i), y(v));
      open = true;
    });
    if (chart.stacked) {
      pen.lineTo(x(values.length - 1), h);
      pen.lineTo(x(0), h);
      pen.fill();
    } else {
      pen.stroke();
      if (values.length === 1) pen.fillRect(x(0) - 2, y(values[0] || 0) - 2, 4, 4);
    }
  }
  if (chart.limit) {
    pen.strokeStyle = "#e5484d";
    pen.setLineDash([4, 3]);
    pen.beginPath();
    pen.moveTo(0, y(chart.limit));
    pen.lineTo(w, y(chart.limit));
    pen.stroke();
  }
  pen.fillStyle = "#8c96a3";
  pen.font = "10px system-ui, sans-serif";
  pen.fillText(number(most), 3, 9);
}
