// The phone's orientation and motion, and the log of them that `--attitude` takes (docs/phone_capture.md).

/** A browser reports a reading when it changes: after HELD_MS without one it is what it was. */
const RATE_HZ = 60, HELD_MS = 250, STILL_MS = 20;

/** The quaternion (w, x, y, z) from the device to a world with z up of the angles that `deviceorientation` tells, in deg: turned about z, then
 * the new x, then the new y. @param {number} alpha @param {number} beta @param {number} gamma */
export function fromAngles(alpha, beta, gamma) {
  const [a, b, c] = [alpha, beta, gamma].map((deg) => (deg * Math.PI) / 360);
  const [ca, sa, cb, sb, cc, sc] = [Math.cos(a), Math.sin(a), Math.cos(b), Math.sin(b), Math.cos(c), Math.sin(c)];
  return [ca * cb * cc - sa * sb * sc, ca * sb * cc - sa * cb * sc, ca * cb * sc + sa * sb * cc, ca * sb * sc + sa * cb * cc];
}

/** Where up is, along the device's x, y and z. @param {number[]} q quaternion (w, x, y, z) */
export function up([w, x, y, z]) {
  return [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

/** The log of samples, each a time (ms, of the page) and values, with 0 at the first frame of the video.
 * @param {Map<string, {names: string[], rows: number[][]}>} samples @param {number} startMs @param {number} endMs @param {Record<string, string>} phone */
export function logOf(samples, startMs, endMs, phone) {
  /** @type {Record<string, any>} */
  const log = { frame: "device", clock: "pictures", phone };
  for (const [sensor, { names, rows }] of samples) {
    const kept = inOrder(rows, sensor === "orientation" ? endMs : -Infinity).filter((row) => row[0] > startMs - 500 && row[0] < endMs + 500);
    if (kept.length < 2) continue;
    log[sensor] = { time_s: kept.map((row) => round(round(row[0], 2) - round(startMs, 2), 2) / 1000) };
    names.forEach((name, i) => { log[sensor][name] = kept.map((row) => round(row[i + 1], 6)); });
  }
  return log.orientation ? log : null;
}

/** Readings by their times: a busy page hears of some late. Those until `heldMs` are held. @param {number[][]} rows @param {number} heldMs */
function inOrder(rows, heldMs) {
  const sorted = [...rows].sort((a, b) => a[0] - b[0]);
  return sorted.flatMap((row, i) => {
    const following = sorted[i + 1]?.[0], next = following ?? Math.max(heldMs, row[0] + 1);
    if (round(next, 2) <= round(row[0], 2)) return [];
    const isHeld = heldMs > row[0] && (following === undefined || following - row[0] > HELD_MS);
    const n = isHeld ? Math.ceil((next - row[0]) / STILL_MS) - 1 : 0;
    return [row, ...Array.from({ length: n }, (_, k) => [row[0] + (k + 1) * STILL_MS, ...row.slice(1)])];
  });
}

/** @param {number} value @param {number} digits */
function round(value, digits) {
  return Math.round(value * 10 ** digits) / 10 ** digits;
}

/** Listens to the sensors that there are. */
export class Sensors {
  constructor() {
    /** @type {Map<string, {names: string[], rows: number[][]}>} */
    this.samples = new Map();
    this.source = "";
    /** @type {number[]|null} */
    this.last = null;
  }

  /** Begin; from a tap, because iOS asks then. */
  async listen() {
    const kinds = /** @type {any} */ (globalThis);
    if (typeof kinds.DeviceOrientationEvent?.requestPermission === "function")
      await kinds.DeviceOrientationEvent.requestPermission().catch(() => "denied");
    addEventListener("deviceorientation", (event) => {
      if (this.source === "RelativeOrientationSensor" || event.alpha === null || event.beta === null || event.gamma === null) return;
      this.source = "deviceorientation";
      this.add("orientation", ["qw", "qx", "qy", "qz"], event.timeStamp, fromAngles(event.alpha, event.beta, event.gamma));
    });
    this.generic(kinds.RelativeOrientationSensor, "orientation", ["qw", "qx", "qy", "qz"], (s) => {
      if (this.source === "deviceorientation") this.samples.clear();  // one source in a log
      this.source = "RelativeOrientationSensor";
      const [x, y, z, w] = s.quaternion;
      return [w, x, y, z];
    });
    for (const [Kind, name] of /** @type {const} */ ([[kinds.Accelerometer, "accelerometer"], [kinds.Gyroscope, "gyroscope"]]))
      this.generic(Kind, name, ["x", "y", "z"], (s) => [s.x, s.y, s.z]);
  }

  /** @param {any} Kind @param {string} sensor @param {string[]} names @param {(s: any) => number[]} read */
  generic(Kind, sensor, names, read) {
    if (!Kind) return;
    try {
      const made = new Kind({ frequency: RATE_HZ });
      made.addEventListener("reading", () => this.add(sensor, names, made.timestamp, read(made)));
      made.start();
    } catch { /* not allowed, or not there: the log goes without */ }
  }

  /** @param {string} sensor @param {string[]} names @param {number} ms @param {number[]} values */
  add(sensor, names, ms, values) {
    const own = this.samples.get(sensor) ?? { names, rows: [] };
    this.samples.set(sensor, own);
    own.rows.push([ms, ...values]);
    if (sensor === "orientation") this.last = values;
  }

  /** Forget what is older than two seconds, but the last: nothing is filmed. */
  trim() {
    const oldest = performance.now() - 2000;
    for (const own of this.samples.values()) own.rows = own.rows.filter((row, i) => row[0] > oldest || i === own.rows.length - 1);
  }
}
