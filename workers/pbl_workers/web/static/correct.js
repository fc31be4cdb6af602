// Correct events: marks on a line that are dragged, moved by the arrow keys, deleted and added, then saved together.
// The player (recording.js) tells the frame that it shows and the frames there are; a mark that moves has it show its own.

import { player, seconds } from "./recording.js";

/** @typedef {{time: number, side: "l"|"r", event: "d"|"u", changed: boolean}} Mark */

/** Pixels of a second; of a mark: its width, and from one lane to the next; of what is above and below all lanes, and between the sides. */
const SECOND = 90, WIDTH = 26, LANE = 40, EDGE = 6, BETWEEN = 16;

/** The events of a form's text, such as "1.2345ld 1.9ru". @param {string} text @returns {Mark[]} */
export function marksOf(text) {
  return [...text.matchAll(/(\d+(?:\.\d+)?)([lr])([du])/g)].map((m) => ({ time: +m[1], side: /** @type {"l"|"r"} */ (m[2]), event: /** @type {"d"|"u"} */ (m[3]), changed: false }));
}

/** The marks in order of time. @param {Mark[]} marks */
const ordered = (marks) => [...marks].sort((a, b) => a.time - b.time);

/** The lane of each mark of one side: those nearer to each other than a mark is wide lie in different ones, so that each can be hit.
 * @param {Mark[]} marks @returns {Map<Mark, number>} */
export function lanesOf(marks) {
  /** @type {number[]} */ const free = [], lanes = new Map();
  for (const m of ordered(marks)) {
    const at = m.time * SECOND, fits = free.findIndex((from) => from <= at), lane = fits < 0 ? free.length : fits;
    free[lane] = at + WIDTH;
    lanes.set(m, lane);
  }
  return lanes;
}

/** The text of events, in order of time. @param {Mark[]} marks */
export function textOf(marks) {
  return ordered(marks).map((m) => `${m.time.toFixed(4)}${m.side}${m.event}`).join(" ");
}

/** The frame whose time is nearest. @param {number[]} times @param {number} at */
export function nearest(times, at) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < at) low = middle + 1; else high = middle;
  }
  return low > 0 && at - times[low - 1] <= times[low] - at ? low - 1 : low;
}

/** @param {HTMLFormElement} form @param {HTMLElement} look @param {number[]} times @param {number} frame the one that is shown */
function edit(form, look, times, frame) {
  const find = (/** @type {string} */ what) => /** @type {any} */ (form.querySelector(what));
  const track = find(".track"), line = find(".line"), said = find(".said"), problem = find(".problem"), words = form.dataset;
  const before = textOf(marksOf(words.events ?? ""));
  let marks = marksOf(words.events ?? "");
  /** @type {Mark|null} */ let chosen = null;
  /** @type {Map<Mark, HTMLButtonElement>} */ const shown = new Map();
  const here = document.createElement("div");
  here.className = "here";
  track.style.width = `${Math.ceil((times[times.length - 1] ?? 0) * SECOND) + 40}px`;
  const x = (/** @type {number} */ time) => 20 + time * SECOND;
  const name = (/** @type {Mark} */ m) => (words.label ?? "").replace("{side}", (m.side === "l" ? words.left : words.right) ?? "")
    .replace("{event}", (m.event === "d" ? words.down : words.up) ?? "").replace("{time}", seconds(m.time));
  const seek = (/** @type {number} */ time) => look.dispatchEvent(new CustomEvent("seek", { detail: time }));
  const changed = () => textOf(marks) !== before;

  const place = (/** @type {Mark} */ m) => {
    const button = shown.get(m);
    if (!button) return;
    button.style.left = `${x(m.time)}px`;
    button.setAttribute("aria-label", name(m));
    button.setAttribute("aria-pressed", String(m === chosen));
    button.className = `mark ${m.side} ${m.event}${m.changed ? " changed" : ""}`;
  };
  const stack = () => {
    let top = EDGE;
    for (const side of ["l", "r"]) {
      const lanes = lanesOf(marks.filter((m) => m.side === side));
      for (const [m, lane] of lanes) { const button = shown.get(m); if (button) button.style.top = `${top + lane * LANE}px`; }
      top += LANE * Math.max(1, ...[...lanes.values()].map((lane) => lane + 1));
      if (side === "l") { track.style.setProperty("--between", `${top}px`); top += BETWEEN; }
    }
    track.style.height = `${top + EDGE}px`;
  };
  const told = () => { stack(); find(".save").disabled = find(".reset").disabled = !changed(); find(".delete").disabled = !chosen; };
  const choose = (/** @type {Mark|null} */ m) => {
    const last = chosen;
    chosen = m;
    if (last) place(last);
    if (m) place(m);
    told();
  };
  const move = (/** @type {Mark} */ m, /** @type {number} */ to) => {
    const time = times[Math.min(Math.max(to, 0), times.length - 1)];
    if (time === m.time) return;
    m.time = time;
    m.changed = true;
    place(m);
    said.textContent = name(m);
    seek(time);
    told();
  };
  const remove = (/** @type {Mark} */ m) => {
    const order = ordered(marks), at = order.indexOf(m), next = order[at + 1] ?? order[at - 1];
    marks = marks.filter((other) => other !== m);
    shown.get(m)?.remove();
    shown.delete(m);
    said.textContent = (words.deleted ?? "").replace("{what}", name(m));
    chosen = null;
    if (next) { choose(next); shown.get(next)?.focus(); }
    told();
  };
  const add = (/** @type {Mark} */ m) => {
    const button = document.createElement("button"), letter = document.createElement("span");
    button.type = "button";
    letter.textContent = m.event === "d" ? "\u25BC" : "\u25B2";
    letter.setAttribute("aria-hidden", "true");
    button.append(letter);
    shown.set(m, button);
    place(m);
    button.addEventListener("focus", () => choose(m));
    button.addEventListener("click", () => { choose(m); seek(m.time); });
    button.addEventListener("keydown", (e) => {
      if (e.ctrlKey || e.altKey || e.metaKey) return;
      if (e.key === "ArrowLeft" || e.key === "ArrowRight") move(m, nearest(times, m.time) + (e.key === "ArrowLeft" ? -1 : 1));
      else if (e.key === "Delete" || e.key === "Backspace") remove(m);
      else return;
      e.preventDefault();
      e.stopPropagation();
    });
    button.addEventListener("pointerdown", (e) => {
      if (e.button !== 0) return;
      button.setPointerCapture(e.pointerId);
      choose(m);
      const from = e.clientX, start = m.time;
      let dragged = false;
      const drag = (/** @type {PointerEvent} */ now) => {
        if (!dragged && Math.abs(now.clientX - from) < 3) return;
        dragged = true;
        move(m, nearest(times, start + (now.clientX - from) / SECOND));
      };
      const end = () => { button.removeEventListener("pointermove", drag); button.removeEventListener("pointerup", end); button.removeEventListener("pointercancel", end); button.focus(); };
      button.addEventListener("pointermove", drag);
      button.addEventListener("pointerup", end);
      button.addEventListener("pointercancel", end);
    });
    track.append(button);
  };
  const build = () => {
    track.replaceChildren(here);
    shown.clear();
    chosen = null;
    for (let s = 0; s <= (times[times.length - 1] ?? 0); s++) {
      const second = document.createElement("div");
      second.className = "second";
      second.style.left = `${x(s)}px`;
      second.textContent = `${s} s`;
      track.append(second);
    }
    for (const m of ordered(marks)) add(m);  // Tab goes through them in order of time
    told();
  };
  build();
  find(".editor").hidden = false;

  const follow = () => {
    const at = x(times[frame]);
    here.style.left = `${at}px`;
    if (at < line.scrollLeft + 30 || at > line.scrollLeft + line.clientWidth - 30) line.scrollLeft = at - line.clientWidth / 3;
  };
  look.addEventListener("frame", (e) => { frame = /** @type {CustomEvent<number>} */ (e).detail; follow(); });
  // On a narrow screen the curves come between the marks and their buttons while marks are corrected.
  const opened = /** @type {HTMLDetailsElement} */ (form.closest("details")), narrow = matchMedia("(max-width: 900px)");
  const curves = /** @type {HTMLElement} */ (look.querySelector(".curves")), seen = /** @type {HTMLElement} */ (look.querySelector(".seen"));
  const arrange = () => {
    (opened.open && narrow.matches ? line : seen).after(curves);
    curves.tabIndex = opened.open ? 0 : -1;  // it scrolls then
    if (opened.open) look.scrollIntoView();
    follow();
  };
  opened.addEventListener("toggle", arrange);
  narrow.addEventListener("change", arrange);
  arrange();
  for (const button of form.querySelectorAll("button.add")) {
    const { side, event } = /** @type {HTMLElement} */ (button).dataset;
    button.addEventListener("click", () => {
      const m = /** @type {Mark} */ ({ time: times[frame], side, event, changed: true });
      marks.push(m);
      add(m);
      choose(m);
      shown.get(m)?.focus();
      said.textContent = name(m);
    });
  }
  find(".delete").addEventListener("click", () => { if (chosen) remove(chosen); });
  find(".reset").addEventListener("click", () => { marks = marksOf(words.events ?? ""); problem.hidden = true; build(); });
  let sent = false;
  addEventListener("beforeunload", (e) => { if (changed() && !sent) e.preventDefault(); });
  // Sent beside the page, so that what the server refuses is said here and the marks stay.
  form.addEventListener("submit", async (e) => {
    const by = /** @type {HTMLButtonElement|null} */ (/** @type {SubmitEvent} */ (e).submitter);
    if (by?.name !== "save") { sent = true; return; }
    e.preventDefault();
    form.elements.namedItem("events").value = textOf(marks);
    by.disabled = true;
    const body = new URLSearchParams(/** @type {any} */ (new FormData(form)));
    const answer = await fetch(form.action, { method: "POST", body }).catch(() => null);
    if (answer?.ok) { sent = true; location.reload(); return; }
    by.disabled = false;
    const page = answer && new DOMParser().parseFromString(await answer.text(), "text/html");
    const parts = page ? [...page.querySelectorAll("main h1, main dd, main > p:not(:has(a))")].map((p) => p.textContent?.trim()) : [];
    problem.textContent = parts.length ? parts.join(". ") : words.failed;
    problem.hidden = false;
  });
}

if (typeof document !== "undefined") {
  const form = /** @type {HTMLFormElement|null} */ (document.querySelector("form.correct"));
  if (form) player.then((shown) => { if (shown) edit(form, shown.look, shown.movement.time, shown.frame); });
}
