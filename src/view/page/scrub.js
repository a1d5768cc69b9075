// The bar of frames: what is there, what is still coarse, what is missing; cuts of a split shot; click and drag.

import { category, css } from "./colors.js";
import { blank } from "./panel.js";

export class Scrub {
  constructor(canvas, seek) {
    this.canvas = canvas;
    this.seek = seek;
    const to = (event) => {
      const box = canvas.getBoundingClientRect();
      const at = (event.clientX - box.left - 8) / Math.max(1, box.width - 16);
      seek(Math.round(Math.max(0, Math.min(1, at)) * this.last));
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      to(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) to(event);
    });
    this.last = 0;
  }

  draw(runs, frame) {
    const { canvas } = this;
    const { pen, w, h } = blank(canvas);
    this.last = Math.max(1, ...runs.map((run) => Math.max(run.wanted, run.lastFrame)));
    const x = (n) => 8 + ((w - 16) * n) / this.last;
    const half = (w - 16) / this.last / 2;
    const row = Math.min(12, (h - 10) / Math.max(1, runs.length));
    const top = (h - row * runs.length) / 2;
    runs.forEach((run, i) => {
      const y = top + i * row + 1;
      const bar = (from, to, color) => {
        pen.fillStyle = color;
        const left = Math.max(8, x(from) - half);
        pen.fillRect(left, y, Math.min(w - 8, x(to) + half) - left, row - 2);
      };
      bar(0, this.last, "#262b33");
      run.coarseRanges.forEach(([from, to]) => bar(from, to, this.hatch(pen)));
      const cuts = run.report?.cuts || [];
      run.fineRanges.forEach(([from, to]) => {
        if (cuts.length < 2) return bar(from, to, "#4f7fae");
        for (let n = from; n <= to; ) {
          const segment = run.segmentOf(n);
          let end = n;
          while (end < to && run.segmentOf(end + 1) === segment) end++;
          bar(n, end, css(category(segment), 0.85));
          n = end + 1;
        }
      });
      const perFrame = run.report?.header.steps_per_frame || 1;
      pen.fillStyle = "#fff";
      cuts.slice(1).forEach((cut) => pen.fillRect(x(cut / perFrame) - 0.5, y - 3, 1, row + 4));
      (run.report?.events || []).forEach((event) => {
        pen.fillStyle = event.let_go ? "#e5484d" : "#f0b429";
        pen.fillRect(x(event.frame) - 0.75, y + row - 4, 1.5, 2);
      });
    });
    pen.fillStyle = "#f4f6f8";
    pen.fillRect(x(frame) - 1, 3, 2, h - 6);
    pen.beginPath();
    pen.arc(x(frame), h / 2, 6, 0, 7);
    pen.fill();
  }

  hatch(pen) {
    if (!this.pattern) {
      const tile = document.createElement("canvas");
      tile.width = tile.height = 6;
      const p = tile.getContext("2d");
      p.fillStyle = "#343b45";
      p.fillRect(0, 0, 6, 6);
      p.strokeStyle = "#7d8895";
      p.lineWidth = 1.2;
      p.beginPath();
      p.moveTo(-1, 7);
      p.lineTo(7, -1);
      p.stroke();
      this.pattern = tile;
    }
    return pen.createPattern(this.pattern, "repeat");
  }
}
