// Detected points as the page draws them (`points.json`: x, y, confidence of each in some frames, by test_web_scripts.py).
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { pointsAt, pointsOf } from "./static/points.js";

const m = JSON.parse(readFileSync("movement.json", "utf8"));
const expected = JSON.parse(readFileSync("points.json", "utf8"));

test("points are where they were detected, to a quarter of a pixel; those that are not known are not drawn", () => {
  const points = pointsOf(new Uint8Array(readFileSync("points.bin")).buffer, m.time.length, m.points);
  let n = 0;
  expected.forEach((rows, frame) => {
    const got = pointsAt(points, frame);
    assert.equal(got.length, rows.length, `frame ${frame}`);
    rows.forEach(([x, y, share], i) => {
      assert.ok(Math.abs(got[i][0] - x) <= 0.2501 && Math.abs(got[i][1] - y) <= 0.2501 && Math.abs(got[i][2] - share) <= 0.0021);
      n++;
    });
  });
  assert.ok(n > 1000);
});
