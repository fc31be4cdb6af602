// Choosing who is measured in the video itself: a box over each person of the shown frame, which sends the form's button.
import { frameAt } from "./recording.js";

/**
 * @typedef {[number, number, number, number, 0|1]} Box
 * @typedef {{size: [number, number], time: number[], people: {number: number, boxes: (Box|null)[]}[]}} People
 */

/** The first frame in which most people are in view. @param {People} p */
export function fullest(p) {
  let best = 0, most = -1;
  for (let frame = 0; frame < p.time.length; frame++) {
    const n = p.people.filter((one) => one.boxes[frame]).length;
    if (n > most) [best, most] = [frame, n];
  }
  return best;
}

/** Where a box lies in the picture, as shares of it, cut to it; null where nothing of it is inside.
 * @param {Box} box @param {[number, number]} size */
export function placed(box, [width, height]) {
  const cut = (/** @type {number} */ v) => Math.min(Math.max(v, 0), 1);
  const [x0, y0, x1, y1] = [cut(box[0] / width), cut(box[1] / height), cut(box[2] / width), cut(box[3] / height)];
  return x1 > x0 && y1 > y0 ? { left: x0, top: y0, width: x1 - x0, height: y1 - y0 } : null;
}

/** Boxes over the video for one form. @param {HTMLElement} stage @param {HTMLVideoElement} video @param {HTMLFormElement} form */
function boxesOf(stage, video, form) {
  const into = document.createElement("div");
  into.className = video.controls ? "boxes above-controls" : "boxes";
  stage.append(into);
  /** @type {Map<number, HTMLButtonElement>} */ const made = new Map();
  /** @type {People|null} */ let people = null;
  const sends = new Map([...form.querySelectorAll("button[name=person]")].map((b) => [+(/** @type {HTMLButtonElement} */ (b)).value, /** @type {HTMLButtonElement} */ (b)]));

  const show = (/** @type {number} */ at) => {
    if (!people) return;
    const frame = frameAt(people.time, at);
    into.dataset.frame = String(frame);
    for (const person of people.people) {
      const button = made.get(person.number), box = person.boxes[frame];
      if (!button) continue;
      const place = box && placed(box, people.size);
      button.hidden = !place;
      if (!place) continue;
      for (const [name, value] of Object.entries(place)) button.style.setProperty(name, `${100 * value}%`);
      button.classList.toggle("carried", !box[4]);
    }
  };
  const step = () => people && people.time.length > 1 ? (people.time[people.time.length - 1] - people.time[0]) / (people.time.length - 1) : 0.04;
  const follow = (/** @type {number} */ _now, /** @type {{mediaTime: number}} */ about) => {
    if (into.hidden) return;
    show(about.mediaTime + 0.25 * step());
    video.requestVideoFrameCallback(follow);
  };

  // As in recording.js: not every frame is told.
  video.addEventListener("seeked", () => { if (video.paused && !video.seeking && !into.hidden) show(video.currentTime); });

  const on = async () => {
    into.hidden = false;
    if (!people) {
      const answer = await fetch(form.dataset.boxes ?? "");
      if (!answer.ok) { into.hidden = true; return; }
      people = /** @type {People} */ (await answer.json());
      stage.style.aspectRatio ||= `${people.size[0]} / ${people.size[1]}`;
      stage.style.width ||= `min(100%, calc(70vh * ${people.size[0] / people.size[1]}))`;
      for (const { number } of people.people) {
        const send = sends.get(number);
        if (!send) continue;
        const button = document.createElement("button");
        button.type = "button";
        button.className = "box";
        button.dataset.person = String(number);
        button.innerHTML = "<span></span>";
        /** @type {HTMLElement} */ (button.firstChild).textContent = String(number);
        button.setAttribute("aria-label", send.textContent?.trim() ?? String(number));
        button.disabled = send.disabled;
        button.addEventListener("click", (e) => { e.stopPropagation(); form.requestSubmit(send); });
        made.set(number, button);
        into.append(button);
      }
      if (video.currentTime === 0) {
        const frame = fullest(people);
        if (frame) video.currentTime = people.time[frame] + 0.5 * step();
      }
    }
    show(video.currentTime);
    video.requestVideoFrameCallback(follow);
    into.dataset.ready = "";
  };
  const off = () => { into.hidden = true; };
  into.hidden = true;
  document.addEventListener("keydown", (e) => {
    if (into.hidden || e.ctrlKey || e.altKey || e.metaKey || !/^[1-9]$/.test(e.key)) return;
    if (/** @type {HTMLElement} */ (e.target).closest("input:not([type=range]):not([type=checkbox]), textarea, select")) return;
    const send = sends.get(+e.key);
    if (send && !send.disabled) form.requestSubmit(send);
  });
  return { on, off, get shown() { return !into.hidden; } };
}

function start() {
  const stage = /** @type {HTMLElement} */ (document.querySelector(".stage")), video = stage.querySelector("video");
  if (!video) return;
  const all = [...document.querySelectorAll("form.choose[data-boxes]")].map((found) => {
    const form = /** @type {HTMLFormElement} */ (found), boxes = boxesOf(stage, video, form);
    return { form, boxes, button: /** @type {HTMLButtonElement} */ (form.querySelector(".in-video")) };
  });
  const turn = (/** @type {typeof all[0]} */ one, /** @type {boolean} */ wanted) => {
    for (const other of all) {
      const is = wanted && other === one;
      if (is !== other.boxes.shown) is ? other.boxes.on() : other.boxes.off();
      other.button.setAttribute("aria-pressed", String(is));
    }
  };
  for (const one of all) {
    one.button.hidden = false;
    one.button.addEventListener("click", () => {
      turn(one, !one.boxes.shown);
      if (one.boxes.shown) stage.scrollIntoView({ block: "nearest" });
    });
  }
  video.addEventListener("error", () => { for (const one of all) { one.boxes.off(); one.button.hidden = true; } });
  const waits = all.find((one) => one.form.dataset.waits !== undefined);
  if (waits && !video.error) turn(waits, true);
}

if (typeof document !== "undefined" && document.querySelector("form.choose[data-boxes]")) start();
