// Colors: palettes of pieces and ranks, color maps of values. Components are sRGB, 0 to 1.

/** Front colors of the cloth where there is one piece: front, back. */
export const CLOTH = [[0.86, 0.45, 0.31], [0.35, 0.50, 0.66]];
export const OBSTACLE = [0.62, 0.64, 0.67];
export const COARSE = [0.66, 0.68, 0.72];

const NAMED = [
  [0.90, 0.49, 0.31], [0.27, 0.62, 0.79], [0.44, 0.73, 0.42], [0.93, 0.74, 0.33],
  [0.69, 0.48, 0.80], [0.86, 0.42, 0.56], [0.35, 0.74, 0.68], [0.60, 0.55, 0.42],
];

function hueColor(hue, saturation, light) {
  const channel = (n) => {
    const k = (n + hue * 12) % 12;
    return light - saturation * Math.min(light, 1 - light) * Math.max(-1, Math.min(k - 3, 9 - k, 1));
  };
  return [channel(0), channel(8), channel(4)];
}

/** Color number i of a palette in which neighbors differ. */
export function category(i) {
  return i < NAMED.length ? NAMED[i] : hueColor((i * 0.61803398875) % 1, 0.55, i % 2 ? 0.62 : 0.5);
}

export function css(color, alpha = 1) {
  return `rgba(${color.map((c) => Math.round(255 * c)).join(",")},${alpha})`;
}

/** Stops of color maps, evenly spaced. */
export const MAPS = {
  // From dark blue over green to yellow, with evenly rising lightness.
  height: [[0.18, 0.20, 0.45], [0.16, 0.42, 0.56], [0.20, 0.62, 0.52], [0.55, 0.77, 0.36], [0.98, 0.88, 0.35]],
  // Pressed blue, at rest gray, stretched red.
  strain: [[0.13, 0.33, 0.72], [0.50, 0.68, 0.88], [0.86, 0.86, 0.85], [0.94, 0.60, 0.42], [0.75, 0.13, 0.16]],
  // Gray where nothing is near, then yellow to red.
  contact: [[0.70, 0.72, 0.75], [0.98, 0.85, 0.45], [0.97, 0.58, 0.25], [0.87, 0.27, 0.20], [0.55, 0.05, 0.15]],
};

/** CSS gradient of a color map. */
export function gradient(name) {
  return `linear-gradient(90deg, ${MAPS[name].map((stop) => css(stop)).join(", ")})`;
}

/** Colors of what a worker does, by activity. */
export const ACTIVITY = [[0.36, 0.64, 0.90], [0.95, 0.66, 0.29], [0.36, 0.39, 0.44]];
