// The log of the phone's page: angles of `deviceorientation` as quaternions, and times on the video's clock.

import assert from "node:assert/strict";
import { test } from "node:test";

import { fromAngles, logOf, Sensors, up } from "./static/capture_sensors.js";

/** @param {number[]} found @param {number[]} expected */
const near = (found, expected) => found.forEach((value, i) => assert.ok(Math.abs(value - expected[i]) < 1e-3, `${found} ${expected}`));

const NAMES = ["qw", "qx", "qy", "qz"], PHONE = { make: "A", model: "B" };
/** @param {number[][]} rows times (ms) and the first value @param {number} start @param {number} end */
const logged = (rows, start, end) =>
  logOf(new Map([["orientation", { names: NAMES, rows: rows.map(([ms, q]) => [ms, q, 0, 0, 0]) }]]), start, end, PHONE).orientation;

test("a phone as docs/phone_capture.md has it", () => {
  near(fromAngles(0, 0, 0), [1, 0, 0, 0]);  // flat, screen up
  near(fromAngles(0, 90, 0), [0.7071, 0.7071, 0, 0]);  // upright in portrait: qx = qw, qz = qy
  const [qw, qx, qy, qz] = fromAngles(40, 90, 0);
  near([qx, qz], [qw, qy]);
});

test("up along the axes of the device", () => {
  near(up(fromAngles(70, 0, 0)), [0, 0, 1]);
  near(up(fromAngles(70, 90, 0)), [0, 1, 0]);  // upright: to the top of the screen
  near(up(fromAngles(0, 0, 90)), [-1, 0, 0]);  // its right edge down
});

test("rotations about z, then the new x, then the new y", () => {
  const multiply = ([a, b, c, d], [e, f, g, h]) =>
    [a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e];
  const about = (axis, deg) => [Math.cos((deg * Math.PI) / 360), ...[0, 1, 2].map((i) => (i === axis ? Math.sin((deg * Math.PI) / 360) : 0))];
  near(fromAngles(30, -50, 20), multiply(multiply(about(2, 30), about(0, -50)), about(1, 20)));
});

test("the log is on the video's clock, without what is far from it", () => {
  const { time_s, qw } = logged([[100, 1], [900, 2], [1020.5, 3], [1100, 4], [9000, 5]], 1000, 1100);
  assert.equal(time_s[time_s.length - 1], 0.1);
  assert.deepEqual([time_s.indexOf(-0.1), time_s.indexOf(0.0205), time_s.indexOf(0.1)].map((i) => qw[i]), [2, 3, 4]);
  assert.ok(time_s[0] > -0.5);
  assert.equal(logOf(new Map(), 0, 1, PHONE), null);
  const rows = [[1000, 1, 0, 0, 0], [1100, 1, 0, 0, 0]];
  assert.equal(logOf(new Map([["orientation", { names: NAMES, rows }]]), 1000, 1100, PHONE)?.clock, "pictures");
});

test("readings of which a busy page hears late, or twice, stand in their order", () => {
  const { time_s, qw } = logged([[1000, 1], [1050, 4], [1016, 2], [1033, 3], [1050.001, 4], [1100, 5]], 1000, 1100);
  assert.deepEqual([time_s, qw], [[0, 0.016, 0.033, 0.05, 0.1], [1, 2, 3, 4, 5]]);
});

test("what no reading follows is held until the next and until the end; a short gap is left to be interpolated", () => {
  const { time_s, qw } = logged([[700, 1], [1490, 2], [1600, 3]], 1000, 2000);
  const at = (/** @type {number} */ s) => qw[time_s.findLastIndex((t) => t <= s + 1e-6)];
  assert.deepEqual([0, 0.48, 0.49, 0.6, 1].map(at), [1, 1, 2, 3, 3]);
  assert.ok(time_s[time_s.length - 1] > 0.95 && !time_s.some((t) => t > 0.49 && t < 0.6));
});

test("a phone that lies still keeps its last reading", () => {
  const sensors = new Sensors();
  sensors.add("orientation", NAMES, -9000, [1, 0, 0, 0]);
  sensors.trim();
  assert.ok(logOf(sensors.samples, 1000, 2000, PHONE).orientation.time_s.length > 50);
});
