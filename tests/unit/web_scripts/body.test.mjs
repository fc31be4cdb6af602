// The body as the page draws it, against what the library draws (`expected.json`, written by test_web_scripts.py).
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { Poses, among, projected, turn, unpacked, unsure } from "./static/body.js";

const read = (name) => JSON.parse(readFileSync(name, "utf8"));
const buffer = (name) => new Uint8Array(readFileSync(name)).buffer;

test("numbers come back from their second differences", () => {
  const channels = [[5, 7, -3, 30000, -30000], [0, 0, 0, 0, 0], [-1, -2, -4, -8, -16]];
  const low = [], high = [];
  for (const c of channels) {
    const d = c.map((v, i) => v - (c[i - 1] ?? 0)), dd = d.map((v, i) => (i < 2 ? v : v - d[i - 1]));
    for (const v of dd) { low.push(v & 255); high.push((v >> 8) & 255); }
  }
  // A difference beyond 16 bit counts round, as it was packed; here none is but the fourth of the first channel.
  const got = unpacked(new Uint8Array([...low, ...high]).buffer, 5);
  assert.deepEqual([...got.slice(0, 3)], [5, 7, -3]);
  assert.deepEqual([...got.slice(5)], [0, 0, 0, 0, 0, -1, -2, -4, -8, -16]);
});

test("a quarter turn about z", () => {
  const out = new Float64Array(3), h = Math.SQRT1_2;
  turn([h, 0, 0, h], 0, [1, 2, 3], 0, out, 0);
  [-2, 1, 3].forEach((v, i) => assert.ok(Math.abs(out[i] - v) < 1e-12));
});

test("what no lens shows is not a number", () => {
  const camera = { lens: [500, 500, 320, 180], distortion: [-0.2, 0, 0, 0, 0], turning: 1 / 0.6, near: 0.05, position: [0, 0, 0], known: [] };
  assert.deepEqual(projected([0, 0, 1], camera), [320, 180]);
  assert.ok(Number.isNaN(projected([0, 0, 0.01], camera)[0]));
  assert.ok(Number.isNaN(projected([0, 0, -3], camera)[0]));
  assert.ok(!Number.isNaN(projected([1.28, 0, 1], camera)[0]));
  assert.ok(Number.isNaN(projected([1.3, 0, 1], camera)[0]));
});

test("runs of frames, and legs that are uncertain", () => {
  assert.deepEqual([0, 1, 3, 4, 9].map((f) => among([[1, 3], [9, 9]], f)), [false, true, true, false, true]);
  const body = { sides: "mlrl", legs: [1, 2] }, spans = { left: [[1, 2]], right: [] };
  assert.deepEqual([0, 1, 2, 3].map((b) => unsure(spans, body, b, 1.5)), [false, true, false, false]);
  assert.equal(unsure(spans, body, 1, 2.5), false);
});

test("every frame is where the library draws it", () => {
  const m = read("movement.json"), expected = read("expected.json");
  const poses = new Poses(m.body, buffer("body.bin"), m.time.length);
  let compared = 0;
  for (const [frame, want] of expected.entries()) {
    const got = poses.seen(frame);
    assert.equal(poses.known(frame), want !== null, `frame ${frame}`);
    if (!want) { assert.ok(got.every(Number.isNaN)); continue; }
    want.forEach((disc, g) => {
      disc.forEach((v, i) => {
        const found = got[7 * g + i];
        if (v === null) { assert.ok(Number.isNaN(found), `frame ${frame}, capsule ${g}`); return; }
        // A millimetre and the half steps of quaternions, at this focal length and distance.
        assert.ok(Math.abs(found - v) < (i === 6 ? 0.01 : 0.5), `frame ${frame}, capsule ${g}, ${i}: ${found} for ${v}`);
        compared++;
      });
    });
  }
  assert.ok(compared > 10_000);
});
