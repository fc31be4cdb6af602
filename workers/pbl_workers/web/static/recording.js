// The player of a recording: the fitted body over the video, curves and events on one time line.
// What is drawn follows the frame that the browser says it shows (requestVideoFrameCallback), never a clock beside it.

import { Poses, among, drawBody } from "./body.js";

/**
 * @typedef {{time: number[], size: [number, number], events: [number, string, string, number][],
 *   curves: ({name: string} & Record<"left"|"right", {value: (number|null)[], half: (number|null)[]}>)[],
 *   stance: Record<string, [number, number][]>, uncertain: Record<string, [number, number][]>,
 *   body: import("./body.js").Body, points: number}} Movement
 * @typedef {{movement: Movement, poses: Poses, look: HTMLElement, canvas: HTMLCanvasElement, frame: number,
 *   watch: (seen: (frame: number) => void) => void, redraw: () => void}} Player
 */

/** The frame that is shown at a time: the last that began by then. @param {number[]} times @param {number} at */
export function frameAt(times, at) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= at + 1e-4) low = middle; else high = middle - 1;
  }
  return low;
}

const $ = (/** @type {string} */ id) => /** @type {any} */ (document.getElementById(id));
/** A time (s) as the page's language writes it. @param {number} time */
export const seconds = (time) => time.toLocaleString(document.documentElement.lang, { minimumFractionDigits: 2, maximumFractionDigits: 2, useGrouping: false });
const colour = (/** @type {string} */ name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** Moves a picture of what is at a time; a video where there is one, else a clock. */
class Clock {
  /** @param {HTMLVideoElement|null} video @param {number[]} times @param {(frame: number) => void} show */
  constructor(video, times, show) {
    this.video = video; this.times = times; this.show = show; this.frame = 0; this.rate = 1; this.playing = false;
    this.changed = () => {};
    if (video) this.#follow(video);
  }

  #follow(/** @type {HTMLVideoElement} */ video) {
    video.controls = false;
    const shown = (_now, /** @type {{mediaTime: number}} */ about) => {
      if (this.video !== video) return;
      this.#at(frameAt(this.times, about.mediaTime + 0.25 * this.#step()));
      video.requestVideoFrameCallback(shown);
    };
    video.requestVideoFrameCallback(shown);
    // Of two seeks within milliseconds Chromium at times tells the first frame only, and shows the second (version 150).
    video.addEventListener("seeked", () => { if (this.video === video && video.paused && !video.seeking) this.#at(frameAt(this.times, video.currentTime)); });
    for (const name of ["play", "pause", "ended"]) video.addEventListener(name, () => { this.playing = !video.paused; this.changed(); });
  }

  #step() { return this.times.length > 1 ? (this.times[this.times.length - 1] - this.times[0]) / (this.times.length - 1) : 0.04; }

  #at(/** @type {number} */ frame) { this.frame = frame; this.show(frame); }

  /** Without a video from now on. */
  alone() { this.video = null; this.#at(this.frame); }

  /** Show a frame. @param {number} frame */
  go(frame) {
    frame = Math.min(Math.max(frame, 0), this.times.length - 1);
    if (!this.video) { this.#at(frame); return; }
    const end = frame + 1 < this.times.length ? this.times[frame + 1] : this.times[frame] + this.#step();
    this.frame = frame;  // a second step does not wait for the first to be shown
    this.video.currentTime = (this.times[frame] + end) / 2;
  }

  speed(/** @type {number} */ rate) { this.rate = rate; if (this.video) this.video.playbackRate = rate; }

  toggle() {
    if (this.video) { this.video.paused ? this.video.play() : this.video.pause(); return; }
    this.playing = !this.playing;
    this.changed();
    if (!this.playing) return;
    if (this.frame === this.times.length - 1) this.frame = 0;
    let last = performance.now(), at = this.times[this.frame];
    const tick = (/** @type {number} */ now) => {
      if (!this.playing) return;
      at += this.rate * (now - last) / 1000; last = now;
      this.#at(frameAt(this.times, at));
      if (this.frame === this.times.length - 1) { this.playing = false; this.changed(); } else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }
}

/** Charts of the joint angles; the returned function moves their cursors. Each writes its values at the pointer, else at the shown frame.
 * @param {Movement} m @param {(at: number) => void} seek */
function charts(m, seek) {
  const into = $("curves"), names = JSON.parse(into.dataset.names), made = [];
  const named = (/** @type {string} */ text, /** @type {string} */ name) => text.replace("{name}", names[name] ?? name);
  let shown = 0;
  const write = (/** @type {number|null|undefined} */ pointed) => {
    for (const { curve, now } of made) {
      now.replaceChildren(...["left", "right"].flatMap((side) => {
        const { value, half } = curve[side] ?? {}, i = pointed ?? shown;
        if (value?.[i] == null) return [];
        const said = document.createElement("span"), error = half[i] == null ? "" : ` \u00B1${Math.ceil(half[i])}`;
        said.className = side;
        said.textContent = `${into.dataset[side]} ${String(Math.round(value[i])).replace("-", "\u2212")}\u00B0${error}`;
        return [said];
      }));
    }
  };
  const build = () => {
    into.replaceChildren();
    made.length = 0;
    for (const curve of m.curves) {
      const figure = document.createElement("figure"), title = document.createElement("figcaption"), now = document.createElement("output");
      title.append(`${named(into.dataset.angle, curve.name)} `, now);
      figure.append(title);
      into.append(figure);
      const data = [m.time], series = [{}], bands = [];
      for (const side of ["left", "right"]) {
        if (!curve[side]) continue;
        const unsure = m.time.map((t) => among(m.uncertain[side], t)), { value, half } = curve[side], ink = colour(side);
        const edge = (sign) => value.map((v, i) => (v === null || half[i] === null ? null : v + sign * half[i]));
        bands.push({ series: [series.length, series.length + 1], fill: ink + "30" });
        for (const sign of [1, -1]) { series.push({ stroke: "transparent", width: 0, points: { show: false } }); data.push(edge(sign)); }
        const dash = side === "left" ? [7, 3] : [];  // as in the charts of a visit; less certain is faint there as well
        series.push({ stroke: ink, width: 2, dash, points: { show: false } });
        data.push(value.map((v, i) => (unsure[i] ? null : v)));
        series.push({ stroke: `${ink}66`, width: 2, dash, points: { show: false } });
        data.push(value.map((v, i) => (unsure[i] || unsure[i - 1] || unsure[i + 1] ? v : null)));
      }
      const axis = { stroke: colour("soft"), grid: { stroke: colour("line"), width: 1 }, ticks: { stroke: colour("line") } };
      const chart = new uPlot({
        width: Math.max(200, into.clientWidth), height: 130, legend: { show: false }, series, bands,
        scales: { x: { time: false } }, cursor: { drag: { x: false, y: false }, points: { show: false }, sync: { key: "curves" } },
        axes: [{ ...axis, size: 26, values: (_, ticks) => ticks.map((t) => `${t} s`) }, { ...axis, size: 38 }],
        hooks: { setCursor: [(u) => write(u.cursor.idx)] },
      }, data, figure);
      chart.root.setAttribute("role", "img");
      chart.root.setAttribute("aria-label", named(into.dataset.chart, curve.name));
      const line = document.createElement("div");
      line.className = "now-line";
      chart.over.append(line);
      chart.over.addEventListener("click", (e) => seek(chart.posToVal(e.offsetX, "x")));
      made.push({ chart, line, curve, now });
    }
  };
  build();
  const move = (/** @type {number} */ frame) => {
    shown = frame;
    for (const { chart, line } of made) line.style.transform = `translateX(${chart.valToPos(m.time[frame], "x")}px)`;
    write(made[0]?.chart.cursor.idx);
  };
  let width = into.clientWidth;
  new ResizeObserver(() => {
    if (into.clientWidth === width) return;
    width = into.clientWidth;
    for (const { chart } of made) chart.setSize({ width: Math.max(200, width), height: 130 });
    move(shown);
  }).observe(into);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { build(); move(shown); });
  return move;
}

/** Foot contacts over the recording. @param {HTMLCanvasElement} canvas @param {Movement} m */
function drawStrip(canvas, m) {
  const box = canvas.getBoundingClientRect(), dense = devicePixelRatio || 1;
  canvas.width = box.width * dense; canvas.height = box.height * dense;
  const c = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const end = m.time[m.time.length - 1] || 1, x = (t) => (t / end) * canvas.width, row = canvas.height / 2;
  ["left", "right"].forEach((side, i) => {
    c.fillStyle = colour(side);
    c.globalAlpha = 0.45;
    for (const [from, to] of m.stance[side]) c.fillRect(x(from), i * row + row * 0.2, x(to) - x(from), row * 0.6);
    c.globalAlpha = 1;
    for (const [t, s, kind] of m.events) if (s === side) c.fillRect(x(t) - dense, i * row + (kind === "foot_down" ? 0 : row * 0.5), 2 * dense, row * 0.5);
  });
}

/** @returns {Promise<Player|null>} */
async function start() {
  const look = /** @type {HTMLElement} */ (document.querySelector(".look[data-fitted]"));
  const number = look.dataset.recording;
  const stage = /** @type {HTMLElement} */ (look.querySelector(".stage"));
  const video = look.querySelector("video"), canvas = /** @type {HTMLCanvasElement} */ (look.querySelector("canvas.body"));
  const [movement, outlines] = await Promise.all(["movement", "body"].map((what) => fetch(`/recordings/${number}/${what}`)));
  if (!movement.ok || !outlines.ok) { document.open(); document.write(await (movement.ok ? outlines : movement).text()); document.close(); return null; }
  /** @type {Movement} */ const m = await movement.json();
  const poses = new Poses(m.body, await outlines.arrayBuffer(), m.time.length);
  const [width, height] = m.size;
  if (m.body.camera) {
    canvas.width = Math.min(width, 1280); canvas.height = Math.round(canvas.width * height / width);
    stage.style.aspectRatio = `${width} / ${height}`;
    stage.style.setProperty("--wide", String(width / height));
  } else {  // markers of a laboratory have no picture: the 3D view is in its place
    stage.hidden = true;
    stage.after(/** @type {HTMLElement} */ (look.querySelector(".space")));
  }
  const controls = /** @type {HTMLElement} */ (look.querySelector(".controls"));
  controls.hidden = /** @type {HTMLElement} */ (look.querySelector(".about")).hidden = false;
  const position = $("position"), now = $("now"), play = $("play");
  position.max = m.time.length - 1;
  const seek = (/** @type {number} */ at) => clock.go(frameAt(m.time, at));
  const cursor = charts(m, seek);
  const show = (/** @type {number} */ frame) => {
    if ($("show-body").checked) drawBody(canvas, m, poses, frame);
    else canvas.getContext("2d")?.clearRect(0, 0, canvas.width, canvas.height);
    canvas.dataset.frame = String(frame);
    position.value = frame;
    now.textContent = `${seconds(m.time[frame])} s, ${now.dataset.text.replace("{n}", frame + 1).replace("{total}", m.time.length)}`;
    cursor(frame);
    for (const seen of watching) seen(frame);
    look.dispatchEvent(new CustomEvent("frame", { detail: frame }));
  };
  /** @type {((frame: number) => void)[]} */ const watching = [];
  const clock = new Clock(video, m.time, show);
  clock.changed = () => { play.textContent = clock.playing ? play.dataset.pause : play.dataset.play; };
  const refused = () => { $("not-played").hidden = false; video?.remove(); clock.alone(); };
  if (video) { video.addEventListener("error", refused); if (video.error) refused(); }
  show(0);
  drawStrip($("strip"), m);
  new ResizeObserver(() => drawStrip($("strip"), m)).observe($("strip"));
  const event = (/** @type {number} */ way) => {
    const at = m.time[clock.frame], times = m.events.map((e) => e[0]);
    const next = way > 0 ? times.find((t) => frameAt(m.time, t) > clock.frame) : times.findLast((t) => frameAt(m.time, t) < clock.frame);
    if (next !== undefined) seek(next);
    return at;
  };
  const speeds = $("speed");
  const faster = (/** @type {number} */ by) => { speeds.selectedIndex = Math.min(Math.max(speeds.selectedIndex + by, 0), speeds.length - 1); clock.speed(+speeds.value); };
  const keys = { " ": () => clock.toggle(), ",": () => clock.go(clock.frame - 1), ".": () => clock.go(clock.frame + 1), j: () => event(-1), l: () => event(1),
    "-": () => faster(-1), "+": () => faster(1) };
  document.addEventListener("keydown", (e) => {
    const typing = /** @type {HTMLElement} */ (e.target).closest("input:not([type=range]):not([type=checkbox]), textarea, select, button, a, summary");
    const act = keys[/** @type {keyof typeof keys} */ (e.key.toLowerCase())];
    if (!act || e.ctrlKey || e.altKey || e.metaKey || (typing && (e.key === " " || typing.matches("input, textarea, select")))) return;
    e.preventDefault();
    act();
  });
  play.addEventListener("click", () => clock.toggle());
  stage.addEventListener("click", () => clock.toggle());
  $("back").addEventListener("click", () => clock.go(clock.frame - 1));
  $("forward").addEventListener("click", () => clock.go(clock.frame + 1));
  $("event-back").addEventListener("click", () => event(-1));
  $("event-forward").addEventListener("click", () => event(1));
  speeds.addEventListener("change", () => clock.speed(+speeds.value));
  position.addEventListener("input", () => clock.go(+position.value));
  $("show-body").addEventListener("change", () => show(clock.frame));
  for (const button of document.querySelectorAll("button[data-time]")) button.addEventListener("click", () => seek(+(/** @type {HTMLElement} */ (button).dataset.time ?? 0)));
  look.addEventListener("seek", (e) => seek(/** @type {CustomEvent<number>} */ (e).detail));
  // Where the body is fitted later only, the page begins there: before, the view may be empty.
  const begin = m.body.known[0]?.[0] ?? 0;
  if (begin > 0 && (!video || (video.paused && video.currentTime === 0))) clock.go(begin);
  look.dataset.ready = "";
  return { movement: m, poses, look, canvas, get frame() { return clock.frame; }, watch: (seen) => { watching.push(seen); seen(clock.frame); },
    redraw: () => show(clock.frame) };
}

/** What other scripts of the page follow; null where nothing is fitted or shown. @type {Promise<Player|null>} */
export const player = typeof document !== "undefined" && document.querySelector(".look[data-fitted]") ? start() : Promise.resolve(null);
