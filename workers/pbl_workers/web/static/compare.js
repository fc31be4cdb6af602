// Videos in step: each shows the same percent of its own gait cycle, whatever its length.

/** @typedef {{video: HTMLVideoElement, start: number, end: number}} Shown */

/** The time of a phase in a cycle. @param {{start: number, end: number}} cycle @param {number} phase 0 to 1 */
export const timeAt = (cycle, phase) => cycle.start + phase * (cycle.end - cycle.start);

/** The phase at a time of a cycle, beyond 0 to 1 outside of it. @param {{start: number, end: number}} cycle @param {number} at */
export const phaseAt = (cycle, at) => (at - cycle.start) / (cycle.end - cycle.start);

/** How fast a video of a cycle plays so that a phase takes as long in all. @param {number} length @param {number} common @param {number} speed */
export const rateOf = (length, common, speed) => Math.min(Math.max((speed * length) / common, 0.0625), 16);

const settled = (/** @type {HTMLVideoElement} */ video) => new Promise((done) => {
  if (!video.seeking) { done(undefined); return; }
  video.addEventListener("seeked", () => done(undefined), { once: true });
  video.addEventListener("error", () => done(undefined), { once: true });
});

/** Moves all videos by one phase. */
export class Together {
  /** @param {Shown[]} all @param {(phase: number, playing: boolean) => void} changed */
  constructor(all, changed) {
    this.all = all; this.changed = changed; this.phase = 0; this.speed = 1; this.playing = false; this.wanted = new Map(); this.turn = 0;
  }

  /** Seconds of a whole cycle at speed 1: the mean of all. */
  get common() { return this.all.reduce((sum, s) => sum + s.end - s.start, 0) / this.all.length; }

  /** Show a phase. What is asked for while a video still seeks is done after that. @param {number} phase */
  go(phase) {
    this.phase = Math.min(Math.max(phase, 0), 1);
    for (const one of this.all) this.#seek(one);
    this.changed(this.phase, this.playing);
  }

  #seek(/** @type {Shown} */ one) {
    const busy = this.wanted.has(one), sought = this.phase;
    this.wanted.set(one, sought);
    if (busy) return;
    one.video.currentTime = timeAt(one, sought);
    settled(one.video).then(() => {
      const asked = this.wanted.get(one);
      this.wanted.delete(one);
      if (asked !== sought) this.#seek(one);
    });
  }

  stop() {
    this.playing = false; this.turn++;
    for (const { video } of this.all) video.pause();
    this.go(this.phase);
  }

  async play() {
    const turn = ++this.turn;
    this.playing = true;
    if (this.phase >= 1) this.phase = 0;
    while (this.playing && turn === this.turn) {
      this.go(this.phase);
      await Promise.all(this.all.map(({ video }) => settled(video)));
      if (turn !== this.turn) return;
      await Promise.all(this.all.map((s) => { s.video.playbackRate = rateOf(s.end - s.start, this.common, this.speed); return s.video.play().catch(() => {}); }));
      await this.#follow(turn);
      if (turn !== this.turn) return;
      for (const { video } of this.all) video.pause();
      this.phase = 0;
    }
  }

  /** Let the videos run to the end of the cycle. They lead: the phase is the median of theirs, and one that is behind or
   * ahead of it plays faster or slower. A clock beside them would hurry those that have only begun to play. */
  #follow(/** @type {number} */ turn) {
    return new Promise((done) => {
      const begun = performance.now(), longest = (3000 * this.common) / this.speed + 2000;
      const tick = (/** @type {number} */ now) => {
        if (turn !== this.turn) { done(undefined); return; }
        const at = this.all.map((one) => (one.video.ended ? 1 : phaseAt(one, one.video.currentTime)));
        this.phase = Math.min(Math.max(median(at), 0), 1);
        this.all.forEach((one, i) => {
          const off = at[i] - this.phase, { video } = one;
          if (video.seeking || video.ended) return;
          if (Math.abs(off) > 0.15) video.currentTime = timeAt(one, this.phase);
          else video.playbackRate = rateOf((one.end - one.start) * Math.min(Math.max(1 - 4 * off, 0.5), 1.5), this.common, this.speed);
        });
        this.changed(this.phase, true);
        if (this.phase >= 1 || now - begun > longest) done(undefined); else requestAnimationFrame(tick);
      };
      requestAnimationFrame(tick);
    });
  }
}

/** @param {number[]} values */
function median(values) {
  const sorted = [...values].sort((a, b) => a - b), middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}

/** Lines in the charts that stand at the phase. @returns {(phase: number) => void} */
function lines() {
  const made = [], plot = /** @type {HTMLElement|null} */ (document.querySelector(".charts"))?.dataset.plot ?? "0 0 0 0";
  const [left, top, right, bottom] = plot.split(" ");
  for (const svg of document.querySelectorAll(".charts figure > svg")) {
    const line = document.createElementNS("http://www.w3.org/2000/svg", "line");
    line.setAttribute("class", "phase-line");
    line.setAttribute("y1", top); line.setAttribute("y2", bottom);
    svg.append(line);
    made.push(line);
  }
  return (phase) => {
    const x = String(+left + phase * (+right - +left));
    for (const line of made) { line.setAttribute("x1", x); line.setAttribute("x2", x); }
  };
}

function start() {
  const section = /** @type {HTMLElement} */ (document.querySelector(".together"));
  /** @type {Shown[]} */ const all = [];
  for (const video of section.querySelectorAll("video")) {
    const shown = { video, start: +(video.dataset.start ?? 0), end: +(video.dataset.end ?? 0) };
    const src = video.getAttribute("src")?.split("#")[0] ?? "";
    video.src = src;  // without the part of the time, at which a browser stops by itself
    video.controls = false;
    video.addEventListener("error", () => {
      const problem = /** @type {HTMLElement} */ (video.nextElementSibling);
      problem.hidden = false; video.hidden = true;
      all.splice(all.indexOf(shown), 1);
    }, { once: true });
    all.push(shown);
    const label = /** @type {HTMLElement} */ (video.parentElement?.querySelector("label"));
    const select = /** @type {HTMLSelectElement} */ (label.querySelector("select"));
    label.hidden = false;
    select.addEventListener("change", () => {
      const { video: number, start, end } = select.selectedOptions[0].dataset;
      const other = `/recordings/${number}/video`;
      shown.start = +(start ?? 0); shown.end = +(end ?? 0);
      if (other !== video.getAttribute("src")) video.src = other;
      together.stop();
    });
  }
  const phase = /** @type {HTMLInputElement} */ (document.getElementById("phase")), now = /** @type {HTMLElement} */ (document.getElementById("phase-now"));
  const play = /** @type {HTMLElement} */ (document.getElementById("phase-play")), speed = /** @type {HTMLSelectElement} */ (document.getElementById("phase-speed"));
  const move = lines();
  const together = new Together(all, (at, playing) => {
    phase.value = String(Math.round(100 * at));
    now.textContent = `${Math.round(100 * at)} %`;
    play.textContent = (playing ? play.dataset.pause : play.dataset.play) ?? "";
    section.dataset.phase = at.toFixed(3);
    move(at);
  });
  /** @type {HTMLElement} */ (section.querySelector(".phase")).hidden = false;
  phase.addEventListener("input", () => { if (together.playing) together.stop(); together.go(+phase.value / 100); });
  play.addEventListener("click", () => { together.playing ? together.stop() : together.play(); });
  speed.addEventListener("change", () => { together.speed = +speed.value; });
  Promise.all(all.map(({ video }) => new Promise((done) => (video.readyState ? done(undefined) : video.addEventListener("loadedmetadata", done, { once: true }))))).then(() => {
    together.go(0);
    section.dataset.ready = "";
  });
}

if (typeof document !== "undefined" && document.querySelector(".together video")) start();
