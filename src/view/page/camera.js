// The camera: orbits about a point, pans and zooms; one for all views. Matrices are column-major.

export function perspective(fovY, aspect, near, far) {
  const f = 1 / Math.tan(fovY / 2);
  const d = 1 / (near - far);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) * d, -1, 0, 0, 2 * far * near * d, 0]);
}

export function orthographic(half, near, far) {
  const d = 1 / (near - far);
  return new Float32Array([1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, 2 * d, 0, 0, 0, (far + near) * d, 1]);
}

export function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) {
    for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
      out[4 * c + r] = sum;
    }
  }
  return out;
}

export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => {
  const length = Math.hypot(...a) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
};

export function lookAt(eye, target, up) {
  const z = unit(sub(eye, target));
  const x = unit(cross(up, z));
  const y = cross(z, x);
  return new Float32Array([
    x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1,
  ]);
}

const FOV = (32 * Math.PI) / 180;

export class Camera {
  constructor() {
    this.target = [0, 0, 0];
    this.distance = 4;
    this.azimuth = 0.6;
    this.elevation = 0.35;
    this.upAxis = "y";
    /** Half the diagonal of what is shown: sets the clipping planes. */
    this.radius = 1;
    this.changed = true;
  }

  get up() {
    return this.upAxis === "z" ? [0, 0, 1] : [0, 1, 0];
  }

  /** Two level axes, the first one is the direction of azimuth 0. */
  get level() {
    return this.upAxis === "z" ? [[0, -1, 0], [1, 0, 0]] : [[0, 0, 1], [1, 0, 0]];
  }

  /** From the target to the eye. */
  get outward() {
    const [ahead, side] = this.level;
    const [c, s] = [Math.cos(this.elevation), Math.sin(this.elevation)];
    const flat = add(ahead.map((v) => v * Math.cos(this.azimuth)), side, Math.sin(this.azimuth));
    return add(flat.map((v) => v * c), this.up, s);
  }

  get eye() {
    return add(this.target, this.outward, this.distance);
  }

  matrices(aspect) {
    const reach = this.distance + 12 * this.radius;
    const near = Math.max(this.distance - 4 * this.radius, reach / 2000);
    const view = lookAt(this.eye, this.target, this.up);
    return { view, projection: perspective(FOV, aspect, near, reach) };
  }

  /** Shows the box [low, high] as a whole in views of this aspect (width / height). */
  fit([low, high], aspect) {
    this.target = low.map((v, i) => (v + high[i]) / 2);
    this.radius = Math.max(1e-6, Math.hypot(...sub(high, low)) / 2);
    const z = this.outward;
    const x = unit(cross(this.up, z));
    const y = cross(z, x);
    const tangent = Math.tan(FOV / 2) * 0.88;
    this.distance = this.radius * 0.01;
    for (let corner = 0; corner < 8; corner++) {
      const at = sub(low.map((v, i) => (corner & (1 << i) ? high[i] : v)), this.target);
      const across = Math.max(Math.abs(dot(at, x)) / aspect, Math.abs(dot(at, y)));
      this.distance = Math.max(this.distance, across / tangent + dot(at, z));
    }
    this.changed = true;
  }

  orbit(dx, dy) {
    this.azimuth -= dx * 0.006;
    this.elevation = Math.max(-1.55, Math.min(1.55, this.elevation + dy * 0.006));
    this.changed = true;
  }

  /** Moves the target with the pointer; `height`: of the view in the pointer's pixels. */
  pan(dx, dy, height) {
    const scale = (2 * this.distance * Math.tan(FOV / 2)) / height;
    const z = this.outward;
    const x = unit(cross(this.up, z));
    const y = cross(z, x);
    this.target = add(add(this.target, x, -dx * scale), y, dy * scale);
    this.changed = true;
  }

  zoom(factor) {
    this.distance = Math.max(this.radius * 0.01, Math.min(this.radius * 60, this.distance * factor));
    this.changed = true;
  }

  /** Pointer, wheel and touch on an element. `redraw` is called after every change. */
  attach(element, redraw) {
    const pointers = new Map();
    let spread = 0;
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      spread = 0;
    });
    const leave = (event) => pointers.delete(event.pointerId);
    element.addEventListener("pointerup", leave);
    element.addEventListener("pointercancel", leave);
    element.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (pointers.size === 2) {
        const [a, b] = [...pointers.values()];
        const now = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (spread > 0 && now > 0) this.zoom(spread / now);
        spread = now;
        this.pan(dx / 2, dy / 2, element.clientHeight);
      } else if (event.buttons & 2 || event.buttons & 4 || event.shiftKey) {
        this.pan(dx, dy, element.clientHeight);
      } else {
        this.orbit(dx, dy);
      }
      redraw();
    });
    element.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 400))));
        redraw();
      },
      { passive: false },
    );
  }
}
