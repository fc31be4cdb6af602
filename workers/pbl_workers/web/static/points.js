// The detected points over the video: filled where the detector is sure of one, hollow where it is not.
import { unpacked } from "./body.js";
import { player } from "./recording.js";

const STEPS = 2;
/** Confidence (of 255) from which on a point is filled: as in the overlay. */
const SURE = 127.5;

/**
 * @typedef {{numbers: Int32Array, shares: Uint8Array, frames: number, count: number}} Points
 */

/** @param {ArrayBuffer} buffer @param {number} frames @param {number} count @returns {Points} */
export function pointsOf(buffer, frames, count) {
  const bytes = 4 * count * frames;
  return { numbers: unpacked(buffer.slice(0, bytes), frames), shares: new Uint8Array(buffer, bytes), frames, count };
}

/** Points of a frame: x, y (px), confidence 0..1. @param {Points} p @param {number} frame @returns {[number, number, number][]} */
export function pointsAt({ numbers, shares, frames, count }, frame) {
  const found = [];
  for (let j = 0; j < count; j++) {
    const share = shares[j * frames + frame];
    if (share) found.push([numbers[2 * j * frames + frame] / STEPS, numbers[(2 * j + 1) * frames + frame] / STEPS, share / 255]);
  }
  return found;
}

/** @param {HTMLCanvasElement} canvas @param {[number, number]} size @param {[number, number, number][]} points */
function draw(canvas, size, points) {
  const c = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d")), f = canvas.width / size[0];
  const radius = Math.max(2, Math.max(canvas.width, canvas.height) / 400);
  for (const [x, y, share] of points) {
    c.beginPath();
    c.arc((x + 0.5) * f, (y + 0.5) * f, radius, 0, 2 * Math.PI);
    c.lineWidth = radius;
    c.strokeStyle = "#14171a";
    c.stroke();
    c.lineWidth = radius / 2;
    c.strokeStyle = c.fillStyle = "#f0e442";
    share * 255 >= SURE ? c.fill() : c.stroke();
  }
}

/** @param {import("./recording.js").Player} shown @param {HTMLInputElement} box */
function start(shown, box) {
  const { movement: m, canvas, look } = shown;
  if (!m.points || !m.body.camera) return;
  /** @type {HTMLElement} */ (box.parentElement).hidden = false;
  /** @type {Points|null} */ let points = null;
  shown.watch((frame) => { if (points && box.checked) draw(canvas, m.size, pointsAt(points, frame)); });
  box.addEventListener("change", async () => {
    if (box.checked && !points) {
      const answer = await fetch(`/recordings/${look.dataset.recording}/points`);
      if (!answer.ok) { box.checked = false; return; }
      points = pointsOf(await answer.arrayBuffer(), m.time.length, m.points);
      canvas.dataset.points = "";
    }
    shown.redraw();
  });
}

const box = typeof document === "undefined" ? null : document.getElementById("show-points");
if (box) player.then((shown) => { if (shown) start(shown, /** @type {HTMLInputElement} */ (box)); });
