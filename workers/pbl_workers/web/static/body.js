// The fitted body as the server sends it (`workers/pbl_workers/web/movement.py`): its poses unpacked, placed in the world and seen
// through the camera of the recording.

/**
 * @typedef {[number, number]} Span
 * @typedef {{lens: [number, number, number, number], distortion: number[], turning: number|null, near: number,
 *   position: [number, number, number], known: Span[]}} Camera
 * @typedef {{sides: string, legs: number[], parent: number[], offset: [number, number, number][], capsules: number[][],
 *   floor: number|null, start: [number, number, number], known: Span[],
 *   steps: {metre: number, turn: number, camera: number}, camera: Camera|null}} Body
 */

/** Whole numbers of channels (C, T) from the low, then the high bytes of their second differences.
 * @param {ArrayBuffer} buffer @param {number} frames */
export function unpacked(buffer, frames) {
  const bytes = new Uint8Array(buffer), n = bytes.length / 2, values = new Int32Array(n);
  for (let i = 0; i < n; i++) values[i] = ((bytes[i] | (bytes[n + i] << 8)) << 16) >> 16;
  for (let c = 0; c < n; c += frames) {
    for (let t = 2; t < frames; t++) values[c + t] += values[c + t - 1];
    for (let t = 1; t < frames; t++) values[c + t] += values[c + t - 1];
  }
  return values;
}

/** Whether a frame lies in runs of frames. @param {Span[]} spans @param {number} frame */
export const among = (spans, frame) => spans.some(([first, last]) => first <= frame && frame <= last);

/** Turn a vector by a unit quaternion (w, x, y, z), the result in `out` from `at` on.
 * @param {ArrayLike<number>} q @param {number} i @param {ArrayLike<number>} v @param {number} j @param {Float64Array|Float32Array} out @param {number} at */
export function turn(q, i, v, j, out, at) {
  const w = q[i], x = q[i + 1], y = q[i + 2], z = q[i + 3], a = v[j], b = v[j + 1], c = v[j + 2];
  const tx = 2 * (y * c - z * b), ty = 2 * (z * a - x * c), tz = 2 * (x * b - y * a);
  out[at] = a + w * tx + y * tz - z * ty;
  out[at + 1] = b + w * ty + z * tx - x * tz;
  out[at + 2] = c + w * tz + x * ty - y * tx;
}

/** The movement of a body, frame by frame. */
export class Poses {
  /** @param {Body} body @param {ArrayBuffer} buffer @param {number} frames */
  constructor(body, buffer, frames) {
    this.body = body; this.frames = frames;
    this.numbers = unpacked(buffer, frames);
    this.count = body.parent.length;
    /** Of each body x, y, z (m) and w, x, y, z of the frame that was placed last. */
    this.placed = new Float64Array(7 * this.count);
    this.at = -1;
    this.discs = new Float64Array(7 * body.capsules.length);
  }

  /** Whether the pose of a frame is known. @param {number} frame */
  known(frame) { return among(this.body.known, frame); }

  /** @param {number} first @param {number} frame @param {number} steps @param {Float64Array} out @param {number} at */
  #quaternion(first, frame, steps, out, at) {
    let length = 0;
    for (let k = 0; k < 4; k++) {
      out[at + k] = this.numbers[(first + k) * this.frames + frame] / steps;
      length += out[at + k] ** 2;
    }
    length = Math.sqrt(length) || 1;
    for (let k = 0; k < 4; k++) out[at + k] /= length;
  }

  /** Where the bodies are in a frame: x, y, z (m) and w, x, y, z of each, in the world. @param {number} frame */
  place(frame) {
    const p = this.placed, { parent, offset, steps, start } = this.body;
    if (frame === this.at) return p;
    this.at = frame;
    for (let b = 0; b < this.count; b++) {
      this.#quaternion(3 + 4 * b, frame, steps.turn, p, 7 * b + 3);
      if (parent[b] < 0) {
        for (let k = 0; k < 3; k++) p[7 * b + k] = start[k] + this.numbers[k * this.frames + frame] / steps.metre;
      } else {
        turn(p, 7 * parent[b] + 3, offset[b], 0, p, 7 * b);
        for (let k = 0; k < 3; k++) p[7 * b + k] += p[7 * parent[b] + k];
      }
    }
    return p;
  }

  /** The capsules in the picture: of each x, y and radius (px) of the discs that its ends project to, and the depth of
   * its middle (m). NaN where the camera does not see it. @param {number} frame */
  seen(frame) {
    const { camera, capsules, steps } = this.body, out = this.discs;
    out.fill(NaN);
    if (!camera || !this.known(frame) || !among(camera.known, frame)) return out;
    const p = this.place(frame), quat = new Float64Array(4), v = new Float64Array(3), at = new Float64Array(3);
    this.#quaternion(3 + 4 * this.count, frame, steps.camera, quat, 0);
    const back = new Float64Array([quat[0], -quat[1], -quat[2], -quat[3]]), focal = 0.5 * (camera.lens[0] + camera.lens[1]);
    capsules.forEach((capsule, g) => {
      const b = capsule[0];
      let depth = 0;
      for (let end = 0; end < 2; end++) {
        turn(p, 7 * b + 3, capsule, 1 + 3 * end, v, 0);
        for (let k = 0; k < 3; k++) v[k] += p[7 * b + k] - camera.position[k];
        turn(back, 0, v, 0, at, 0);
        depth += 0.5 * at[2];
        const seen = projected(at, camera);
        out.set([seen[0], seen[1], Number.isNaN(seen[0]) ? NaN : focal * capsule[7] / at[2]], 7 * g + 3 * end);
      }
      out[7 * g + 6] = depth;
    });
    return out;
  }
}

/** Pixel of a point of the camera's frame (x right, y down, z forward; m), as `render.to_pixels`; NaN where the lens
 * shows none. @param {ArrayLike<number>} at @param {Camera} camera @returns {[number, number]} */
export function projected(at, { lens, distortion, turning, near }) {
  const [k1, k2, p1, p2, k3] = distortion;
  const x = at[0] / at[2], y = at[1] / at[2], r2 = x * x + y * y;
  if (!(at[2] >= near) || (turning !== null && !(r2 < turning))) return [NaN, NaN];
  const radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3));
  return [
    lens[0] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + lens[2],
    lens[1] * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + lens[3],
  ];
}

/** Outline of a capsule: the hull of two discs. @param {CanvasRenderingContext2D} c */
export function capsule(c, x0, y0, r0, x1, y1, r1) {
  const dx = x1 - x0, dy = y1 - y0, d = Math.hypot(dx, dy);
  c.beginPath();
  if (d <= Math.abs(r0 - r1)) {
    r0 > r1 ? c.arc(x0, y0, r0, 0, 2 * Math.PI) : c.arc(x1, y1, r1, 0, 2 * Math.PI);
  } else {
    const along = Math.atan2(dy, dx), open = Math.acos((r0 - r1) / d);
    c.arc(x0, y0, r0, along + open, along - open + 2 * Math.PI);
    c.arc(x1, y1, r1, along - open, along + open);
  }
  c.closePath();
}

/** Colours of the sides: those of the overlay and the report. */
export const FILLS = { l: "#d55e00", r: "#0072b2", m: "#8a8f98" };
const NAMES = { l: "left", r: "right", m: "" };

/** Whether a body belongs to a leg that is uncertain at a time. @param {Record<string, [number, number][]>} uncertain
 * @param {Body} body @param {number} b @param {number} at */
export function unsure(uncertain, body, b, at) {
  const name = NAMES[body.sides[b]];
  return name !== "" && body.legs.includes(b) && uncertain[name].some(([from, to]) => from <= at && at <= to);
}

/** Draw a frame of the body over the picture. @param {HTMLCanvasElement} canvas @param {{size: [number, number],
 * time: number[], uncertain: Record<string, [number, number][]>}} m @param {Poses} poses @param {number} frame */
export function drawBody(canvas, m, poses, frame) {
  const c = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const f = canvas.width / m.size[0], at = m.time[frame], discs = poses.seen(frame), { capsules, sides } = poses.body;
  c.clearRect(0, 0, canvas.width, canvas.height);
  const shown = [];
  for (let g = 0; g < capsules.length; g++) if (discs.subarray(7 * g, 7 * g + 7).every((v) => !Number.isNaN(v))) shown.push(g);
  shown.sort((a, b) => discs[7 * b + 6] - discs[7 * a + 6]);  // far ones first
  c.lineWidth = Math.max(1, canvas.width / 640);
  for (const g of shown) {
    const side = sides[capsules[g][0]], pale = unsure(m.uncertain, poses.body, capsules[g][0], at);
    // Pixel centres are whole numbers.
    const v = [0, 1, 2, 3, 4, 5].map((i) => (discs[7 * g + i] + (i % 3 < 2 ? 0.5 : 0)) * f);
    capsule(c, v[0], v[1], v[2], v[3], v[4], v[5]);
    c.fillStyle = FILLS[side];
    c.strokeStyle = pale ? FILLS[side] : "rgba(0,0,0,.55)";
    c.globalAlpha = pale ? 0.12 : 0.5;
    c.fill();
    c.globalAlpha = pale ? 0.6 : 0.35;
    c.stroke();
  }
  c.globalAlpha = 1;
}
