// While the camera is open: small pictures to the server, which says whether feet or head are cut off.

import { request } from "./capture_takes.js";

const EVERY_MS = 500, SIDE_PX = 640, QUALITY = 0.7;

/** Look twice a second; `told` is called with what is cut off ("" for nothing) once two looks say so.
 * @param {HTMLVideoElement} video @param {(cut: string) => void} told */
export function lookAt(video, told) {
  const canvas = document.createElement("canvas"), context = /** @type {any} */ (canvas.getContext("2d", { willReadFrequently: true }));
  let busy = false, before = "", shown = "";
  return setInterval(async () => {
    const [w, h] = [video.videoWidth, video.videoHeight], scale = Math.min(1, SIDE_PX / Math.max(w, h));
    if (busy || !w || document.hidden || !navigator.onLine) return;
    busy = true;
    [canvas.width, canvas.height] = [Math.round(scale * w), Math.round(scale * h)];
    context.drawImage(video, 0, 0, canvas.width, canvas.height);
    const body = await new Promise((/** @type {BlobCallback} */ go) => canvas.toBlob(go, "image/jpeg", QUALITY));
    const said = await request("/phone/look.json", { method: "POST", headers: { "content-type": "image/jpeg" }, body }).catch(() => null);
    const cut = said?.cut ?? "";
    if (cut === before && cut !== shown) told(shown = cut);
    before = cut;
    busy = false;
  }, EVERY_MS);
}
