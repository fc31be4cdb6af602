// The fitted body in a 3D view that turns, on the time line of the recording. World: z up, metres (`body.js`).
import { FILLS, turn, unsure } from "./body.js";
import { player } from "./recording.js";

/**
 * @typedef {import("./body.js").Poses} Poses
 * @typedef {import("./recording.js").Movement} Movement
 */

/** Where the parts of three.js are (`vendor/README.md`). */
export const THREE_AT = "/vendor/three-0.187.0.min.js";
const DEGREE = Math.PI / 180;
/** Seconds around a frame over which the direction of walking is taken, and the speed (m/s) from which on there is one. */
const AROUND_S = 0.5, WALKS = 0.25;
/** Metres of floor that are drawn to each side of the body. */
const REACH_M = 6;

/** Where the viewer stands: on a sphere around what is looked at. Angles in radians, distance in metres. */
export class Orbit {
  constructor() { this.azimuth = 0; this.elevation = 12 * DEGREE; this.distance = 3.6; }

  /** Go around by these angles; never below the floor by more than a little, nor over the top. @param {number} right @param {number} up */
  turn(right, up) {
    this.azimuth = (this.azimuth + right) % (2 * Math.PI);
    this.elevation = Math.min(Math.max(this.elevation + up, -5 * DEGREE), 89 * DEGREE);
  }

  /** @param {number} factor more than 1: farther away */
  zoom(factor) { this.distance = Math.min(Math.max(this.distance * factor, 1), 20); }

  /** Where the viewer is, from what is looked at. @returns {[number, number, number]} */
  offset() {
    const flat = this.distance * Math.cos(this.elevation);
    return [flat * Math.cos(this.azimuth), flat * Math.sin(this.azimuth), this.distance * Math.sin(this.elevation)];
  }
}

/** Where the root is in a frame (x, y, z in m). @param {Poses} poses @param {number} frame @returns {[number, number, number]} */
export function rootAt(poses, frame) {
  const { start, steps } = poses.body, n = poses.numbers, t = poses.frames;
  return [0, 1, 2].map((k) => start[k] + n[k * t + frame] / steps.metre);
}

/** Direction of walking around a frame, as an angle in the floor from x to y; null if the person stands or nothing is known.
 * @param {Poses} poses @param {number[]} times @param {number} frame */
export function heading(poses, times, frame) {
  const within = poses.body.known.find(([first, last]) => first <= frame && frame <= last);
  if (!within) return null;
  let from = frame, to = frame;
  while (from > within[0] && times[frame] - times[from - 1] <= AROUND_S) from--;
  while (to < within[1] && times[to + 1] - times[frame] <= AROUND_S) to++;
  const a = rootAt(poses, from), b = rootAt(poses, to), seconds = times[to] - times[from];
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  return seconds > 0.2 && Math.hypot(dx, dy) / seconds >= WALKS ? Math.atan2(dy, dx) : null;
}

/** Azimuths of the named views of a movement. @param {Poses} poses @param {number[]} times */
export function views(poses, times) {
  const known = poses.body.known, middle = known.length ? Math.round((known[0][0] + known[0][1]) / 2) : 0;
  const at = rootAt(poses, middle), camera = poses.body.camera?.position, way = heading(poses, times, middle);
  const filmed = camera ? Math.atan2(camera[1] - at[1], camera[0] - at[0]) : null;
  const front = way ?? 0;
  // Of the two sides the one that the camera saw.
  const sides = [front + Math.PI / 2, front - Math.PI / 2];
  const side = filmed !== null && Math.cos(filmed - sides[1]) > Math.cos(filmed - sides[0]) ? sides[1] : sides[0];
  return { filmed: filmed ?? side, side, front };
}

/** The picture. */
export class Space {
  /** @param {HTMLCanvasElement} canvas @param {Movement} movement @param {Poses} poses @param {any} three */
  constructor(canvas, movement, poses, three) {
    this.canvas = canvas; this.movement = movement; this.poses = poses; this.three = three;
    this.orbit = new Orbit();
    this.renderer = new three.WebGLRenderer({ canvas, antialias: !software(), powerPreference: "low-power" });
    this.renderer.setPixelRatio(software() ? 1 : Math.min(devicePixelRatio || 1, 2));
    this.scene = new three.Scene();
    this.camera = new three.PerspectiveCamera(35, 16 / 9, 0.1, 80);
    this.camera.up.set(0, 0, 1);
    this.sun = new three.DirectionalLight(0xffffff, 2);
    this.scene.add(this.sun, this.sun.target, new three.AmbientLight(0xffffff, 1.8));
    const { body } = poses;
    this.shape = new Shape(three, body);
    this.scene.add(this.shape.solid, this.shape.pale);
    this.#floor();
    this.colours();
    this.frame = 0;
  }

  #floor() {
    const { three, poses } = this, { body } = poses, roots = [];
    for (const [first, last] of body.known) for (let t = first; t <= last; t++) roots.push(rootAt(poses, t));
    this.height = body.floor ?? 0;
    this.eye = roots.length ? roots.map((r) => r[2]).sort((a, b) => a - b)[roots.length >> 1] - 0.08 : 0;
    if (body.floor === null || !roots.length) return;
    // Around the body, wherever it walks; metre by metre, because drawing in software drops a line that ends behind the viewer.
    const lines = [];
    for (let i = -REACH_M; i <= REACH_M; i++) for (let j = -REACH_M; j < REACH_M; j++) lines.push(i, j, 0, i, j + 1, 0, j, i, 0, j + 1, i, 0);
    this.grid = new three.LineSegments(points(three, lines), new three.LineBasicMaterial());
    const corners = [roots[0]];  // a point a hand's breadth after the other is enough
    for (const r of roots) { const last = corners[corners.length - 1]; if (Math.hypot(r[0] - last[0], r[1] - last[1]) > 0.2) corners.push(r); }
    this.path = new three.Line(points(three, corners.flatMap((r) => [r[0], r[1], 0.002])), new three.LineBasicMaterial());
    const arrow = [[0.45, 0.035], [0.75, 0.035], [0.75, 0.12], [1.05, 0], [0.75, -0.12], [0.75, -0.035], [0.45, -0.035]];
    const flat = [[0, 1, 5], [0, 5, 6], [2, 3, 4]].flat().flatMap((i) => [...arrow[i], 0.004]);
    this.arrow = new three.Mesh(points(three, flat), new three.MeshBasicMaterial({ side: 2 }));
    for (const part of [this.grid, this.path, this.arrow]) { part.position.z = this.height; this.scene.add(part); }
  }

  /** Colours of the page, light or dark. */
  colours() {
    const style = getComputedStyle(document.documentElement);
    const of = (/** @type {string} */ name) => new this.three.Color(style.getPropertyValue(`--${name}`).trim());
    this.scene.background = of("wash");
    this.grid?.material.color.copy(of("line"));
    this.path?.material.color.copy(of("soft"));
    this.arrow?.material.color.copy(of("ink"));
  }

  /** @param {number} width @param {number} height px */
  resize(width, height) {
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  /** Draw a frame. @param {number} frame */
  draw(frame) {
    this.frame = frame;
    const { poses, movement } = this, p = poses.place(frame), at = movement.time[frame];
    this.shape.place(p, poses.known(frame), (b) => unsure(movement.uncertain, poses.body, b, at));
    const way = heading(poses, movement.time, frame);
    if (this.arrow) {
      this.arrow.visible = way !== null;
      this.arrow.position.set(p[0], p[1], this.height);
      this.arrow.rotation.z = way ?? 0;
      this.grid.position.set(Math.round(p[0]), Math.round(p[1]), this.height);
    }
    const [x, y, z] = this.orbit.offset();
    this.camera.position.set(p[0] + x, p[1] + y, this.eye + z);
    this.camera.lookAt(p[0], p[1], this.eye);
    // The light comes over the viewer's shoulder, so that the side that is looked at is lit.
    this.sun.target.position.set(p[0], p[1], this.eye);
    this.sun.position.set(p[0] + x - 0.5 * y, p[1] + y + 0.5 * x, this.eye + z + this.orbit.distance);
    this.renderer.render(this.scene, this.camera);
    this.canvas.dataset.frame = String(frame);
  }
}

/** @param {any} three @param {number[]} numbers */
function points(three, numbers) {
  const made = new three.BufferGeometry();
  made.setAttribute("position", new three.Float32BufferAttribute(numbers, 3));
  return made;
}

/** All capsules as one shape that is drawn at once, and a translucent one of those that are uncertain: many small ones
 * take a browser that draws in software twice as long. */
class Shape {
  /** @param {any} three @param {import("./body.js").Body} body */
  constructor(three, body) {
    const [caps, around] = software() ? [2, 7] : [4, 14];  // triangles cost there, too
    const position = [], normal = [], colours = [], along = new three.Vector3(), up = new three.Vector3(0, 1, 0), turned = new three.Quaternion();
    /** @type {{first: number, end: number, index: number[]}[]} vertices and triangles of each body */
    this.bodies = body.parent.map((_, b) => {
      const first = position.length / 3, index = [], colour = new three.Color(FILLS[/** @type {"l"|"r"|"m"} */ (body.sides[b])]);
      for (const [, x0, y0, z0, x1, y1, z1, radius] of body.capsules.filter((c) => c[0] === b)) {
        along.set(x1 - x0, y1 - y0, z1 - z0);
        const length = along.length(), before = position.length / 3, one = new three.CapsuleGeometry(radius, length, caps, around, 1);
        turned.setFromUnitVectors(up, length > 1e-6 ? along.divideScalar(length) : up);
        one.applyQuaternion(turned).translate((x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2);
        position.push(...one.attributes.position.array);
        normal.push(...one.attributes.normal.array);
        index.push(...Array.from(one.index.array, (i) => i + before));
      }
      for (let v = first; v < position.length / 3; v++) colours.push(colour.r, colour.g, colour.b);
      return { first, end: position.length / 3, index };
    });
    this.position = position; this.normal = normal;
    this.shown = "";
    const attributes = { position, normal, color: colours };
    const made = [{}, { transparent: true, opacity: 0.3, depthWrite: false }].map((how) => {
      const geometry = new three.BufferGeometry();
      const mesh = new three.Mesh(geometry, new three.MeshLambertMaterial({ vertexColors: true, ...how }));
      mesh.frustumCulled = false;
      return mesh;
    });
    [this.solid, this.pale] = made;
    for (const [name, numbers] of Object.entries(attributes)) {
      const attribute = new three.Float32BufferAttribute(numbers, 3);
      for (const mesh of made) mesh.geometry.setAttribute(name, attribute);
    }
  }

  /** Move it to where the bodies are. @param {Float64Array} p of `Poses.place` @param {boolean} known
   * @param {(b: number) => boolean} uncertain */
  place(p, known, uncertain) {
    const pale = this.bodies.map((_, b) => uncertain(b)), shown = known ? pale.map(Number).join("") : "none";
    if (shown !== this.shown) {
      this.shown = shown;
      this.solid.geometry.setIndex(known ? this.bodies.flatMap((body, b) => pale[b] ? [] : body.index) : []);
      this.pale.geometry.setIndex(known ? this.bodies.flatMap((body, b) => pale[b] ? body.index : []) : []);
      this.pale.visible = known && pale.includes(true);
      this.solid.visible = known;
    }
    if (!known) return;
    const { position, normal } = this.solid.geometry.attributes, to = position.array, out = normal.array;
    this.bodies.forEach(({ first, end }, b) => {
      for (let i = 3 * first; i < 3 * end; i += 3) {
        turn(p, 7 * b + 3, this.position, i, to, i);
        turn(p, 7 * b + 3, this.normal, i, out, i);
        for (let k = 0; k < 3; k++) to[i + k] += p[7 * b + k];
      }
    });
    position.needsUpdate = true;
    normal.needsUpdate = true;
  }
}

/** @type {boolean|undefined} */ let drawnBySoftware;
/** Whether the browser draws without a graphics processor: then without smoothed edges, which cost most. */
export function software() {
  if (drawnBySoftware === undefined) {
    const gl = document.createElement("canvas").getContext("webgl2"), about = gl?.getExtension("WEBGL_debug_renderer_info");
    drawnBySoftware = !!gl && !!about && /swiftshader|llvmpipe|software/i.test(gl.getParameter(about.UNMASKED_RENDERER_WEBGL));
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
  }
  return drawnBySoftware;
}

/** Turn the view by mouse, touch and keys. @param {HTMLElement} at @param {Orbit} orbit @param {() => void} changed @param {() => void} reset */
function turnable(at, orbit, changed, reset) {
  /** @type {Map<number, {x: number, y: number}>} */ const down = new Map();
  const apart = () => { const [a, b] = [...down.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  at.addEventListener("pointerdown", (e) => { down.set(e.pointerId, { x: e.clientX, y: e.clientY }); at.setPointerCapture(e.pointerId); });
  at.addEventListener("pointermove", (e) => {
    const last = down.get(e.pointerId);
    if (!last) return;
    const before = down.size === 2 ? apart() : 0;
    if (down.size === 1) orbit.turn(-(e.clientX - last.x) * 0.5 * DEGREE, (e.clientY - last.y) * 0.4 * DEGREE);
    last.x = e.clientX; last.y = e.clientY;
    if (down.size === 2 && before > 0) orbit.zoom(before / Math.max(apart(), 1));
    changed();
  });
  for (const name of ["pointerup", "pointercancel"]) at.addEventListener(name, (e) => down.delete(/** @type {PointerEvent} */ (e).pointerId));
  at.addEventListener("wheel", (e) => {
    if (document.activeElement !== at && !e.ctrlKey) return;  // who scrolls the page scrolls over it
    e.preventDefault();
    orbit.zoom(Math.exp(e.deltaY * 0.001));
    changed();
  }, { passive: false });
  /** @type {Record<string, () => void>} */ const keys = {
    ArrowLeft: () => orbit.turn(-10 * DEGREE, 0), ArrowRight: () => orbit.turn(10 * DEGREE, 0), ArrowUp: () => orbit.turn(0, 5 * DEGREE),
    ArrowDown: () => orbit.turn(0, -5 * DEGREE), "+": () => orbit.zoom(1 / 1.15), "-": () => orbit.zoom(1.15), Home: reset,
  };
  at.addEventListener("keydown", (e) => {
    const act = keys[e.key];
    if (!act || e.ctrlKey || e.altKey || e.metaKey) return;
    e.preventDefault();
    e.stopPropagation();  // plus and minus are not the speed here
    act();
    changed();
  });
}

/** @param {import("./recording.js").Player} shown @param {HTMLElement} section */
async function start(shown, section) {
  const host = /** @type {HTMLElement} */ (section.querySelector(".space-view")), canvas = /** @type {HTMLCanvasElement} */ (section.querySelector("canvas"));
  const without = /** @type {HTMLElement} */ (section.querySelector(".no-webgl"));
  const fails = () => { without.hidden = false; host.hidden = true; /** @type {HTMLElement} */ (section.querySelector(".with-webgl")).hidden = true; };
  if (!document.createElement("canvas").getContext("webgl2")) { fails(); return; }
  const space = new Space(canvas, shown.movement, shown.poses, await import(THREE_AT));
  const named = views(shown.poses, shown.movement.time);
  const look = (/** @type {string} */ name) => {
    space.orbit = Object.assign(space.orbit, new Orbit());
    if (name === "above") { space.orbit.azimuth = named.side; space.orbit.elevation = 89 * DEGREE; }
    else space.orbit.azimuth = named[/** @type {keyof typeof named} */ (name)];
  };
  look("filmed");
  let visible = true, waits = false;
  const draw = () => { waits = false; if (visible && !host.hidden) space.draw(shown.frame); };
  const later = () => { if (!waits) { waits = true; requestAnimationFrame(draw); } };
  const size = () => { space.resize(host.clientWidth, Math.max(1, host.clientHeight)); later(); };
  new ResizeObserver(size).observe(host);
  size();
  new IntersectionObserver((entries) => { visible = entries[entries.length - 1].isIntersecting; if (visible) draw(); }).observe(host);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { space.colours(); later(); });
  canvas.addEventListener("webglcontextlost", fails);
  turnable(host, space.orbit, later, () => look("filmed"));
  for (const button of /** @type {NodeListOf<HTMLButtonElement>} */ (section.querySelectorAll("button[data-view]"))) {
    button.addEventListener("click", () => { look(button.dataset.view ?? ""); later(); });
  }
  shown.watch(draw);
  section.dataset.ready = "";
}

const section = /** @type {HTMLElement|null} */ (typeof document === "undefined" ? null : document.querySelector(".space"));
if (section) {
  player.then((shown) => {
    if (!shown) return;
    section.hidden = false;
    // 140 kB of scripts, on first use.
    const coming = new IntersectionObserver((entries) => { if (entries.some((e) => e.isIntersecting)) { coming.disconnect(); start(shown, section); } }, { rootMargin: "300px" });
    coming.observe(section);
  });
}
