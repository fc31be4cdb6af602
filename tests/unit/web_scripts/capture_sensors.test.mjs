// The log of the phone's page: angles of `deviceorientation` as quaternions, and times on the video's clock.

import assert from "node:assert/strict";
import { test } from "node:test";

import { fromAngles, logOf, up } from "./static/capture_sensors.js";

/** @param {number[]} found @param {number[]} expected */
const near = (found, expected) => found.forEach((value, i) => assert.ok(Math.abs(value - expected[i]) < 1e-3, `${found} ${expected}`));

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

test("the log is on the video's clock, in order, without what is far from it", () => {
  const rows = [[100, 1, 0, 0, 0], [900, 1, 0, 0, 0], [900, 1, 0, 0, 0], [1020.5, 0.5, 0.5, 0.5, 0.5], [9000, 1, 0, 0, 0]];
  const log = logOf(new Map([["orientation", { names: ["qw", "qx", "qy", "qz"], rows }]]), 1000, 2000, { make: "A", model: "B" });
  assert.deepEqual(log.orientation.time_s, [-0.1, 0.0205]);
  assert.deepEqual(log.orientation.qx, [0, 0.5]);
  assert.equal(log.frame, "device");
  assert.equal(logOf(new Map(), 0, 1, {}), null);
});
