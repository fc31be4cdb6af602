// The 3D view: where the viewer stands, and which way somebody walks.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { Poses } from "./static/body.js";
import { Orbit, heading, rootAt, views } from "./static/space.js";

const near = (a, b, by = 1e-9) => assert.ok(Math.abs(a - b) <= by, `${a} for ${b}`);
const m = JSON.parse(readFileSync("movement.json", "utf8"));
const root = JSON.parse(readFileSync("root.json", "utf8"));
const poses = () => new Poses(m.body, new Uint8Array(readFileSync("body.bin")).buffer, m.time.length);

test("the viewer stays at her distance, above the floor and not over the top", () => {
  const orbit = new Orbit();
  orbit.turn(1, 5);
  near(Math.hypot(...orbit.offset()), orbit.distance);
  near(orbit.elevation, 89 * Math.PI / 180);
  orbit.turn(0, -9);
  near(orbit.elevation, -5 * Math.PI / 180);
  for (let i = 0; i < 50; i++) orbit.zoom(2);
  assert.equal(orbit.distance, 20);
  for (let i = 0; i < 50; i++) orbit.zoom(0.5);
  assert.equal(orbit.distance, 1);
});

test("the root is where the fit has it", () => {
  const p = poses();
  for (const t of [5, 6, 40, 79]) rootAt(p, t).forEach((v, k) => near(v, root[t][k], 6e-4));
});

test("the direction of walking is that of the movement, and none where somebody stands or is not seen", () => {
  const p = poses(), t = 40, way = heading(p, m.time, t);
  near(Math.cos(way - Math.atan2(root[t + 15][1] - root[t - 15][1], root[t + 15][0] - root[t - 15][0])), 1, 1e-3);
  assert.equal(heading(p, m.time, 2), null);
  assert.notEqual(heading(p, m.time, 5), null);  // the first known frame: what comes after it counts
  for (let k = 0; k < 3; k++) p.numbers.fill(0, k * p.frames, (k + 1) * p.frames);
  assert.equal(heading(p, m.time, t), null);
});

test("the named views: from where it was filmed, and from that side", () => {
  const p = poses(), { filmed, side, front } = views(p, m.time), at = rootAt(p, 42), camera = m.body.camera.position;
  near(Math.cos(filmed - Math.atan2(camera[1] - at[1], camera[0] - at[0])), 1, 1e-3);
  near(Math.abs(Math.sin(side - front)), 1, 1e-9);
  assert.ok(Math.cos(side - filmed) > 0);
});
