// While the camera is open: small pictures to the server, which says whether feet or head are cut off.

import { Refusal, request } from "./capture_takes.js";

const EVERY_MS = 500, PATIENCE_MS = 3000, SIDE_PX = 640, QUALITY = 0.7;

/** Look twice a second; `told` is called with what is cut off ("" for nothing, and where it cannot be known) once two
 * looks say so. @param {HTMLVideoElement} video @param {(cut: string) => void} told */
export function lookAt(video, told) {
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d", { willReadFrequently: true });
  let busy = false, before = "", shown = "";
  const look = setInterval(async () => {
    if (busy) return;
    busy = true;
    try {
      const said = await ask();
      if (!said) return;  // the server looks at another phone's
      if (said.cut === before && before !== shown) told(shown = before);
      before = said.cut;
    } catch (error) {
      if (error instanceof Refusal && (error.code === "PHONE_LINK" || error.status === 401)) clearInterval(look);
    } finally { busy = false; }
  }, EVERY_MS);

  /** @returns {Promise<{cut: string}|null>} */
  async function ask() {
    const [w, h] = [video.videoWidth, video.videoHeight], scale = Math.min(1, SIDE_PX / Math.max(w, h));
    if (!w || document.hidden || !navigator.onLine || !(/** @type {MediaStream|null} */ (video.srcObject)?.active)) return { cut: "" };
    [canvas.width, canvas.height] = [Math.round(scale * w), Math.round(scale * h)];
    context?.drawImage(video, 0, 0, canvas.width, canvas.height);
    const body = await new Promise((/** @type {BlobCallback} */ go) => canvas.toBlob(go, "image/jpeg", QUALITY));
    const more = { method: "POST", headers: { "content-type": "image/jpeg" }, body, signal: AbortSignal.timeout(PATIENCE_MS) };
    const said = await request("/phone/look.json", more).catch((error) => { if (error instanceof Refusal) throw error; return { cut: "" }; });
    return said && { cut: said.cut ?? "" };
  }
}
