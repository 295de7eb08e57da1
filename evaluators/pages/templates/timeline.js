"use strict";
// Time and pose of tracks. Times are milliseconds after the scene's first camera frame, lengths centimetres, headings milliradians.

// Index of the last time that is not after t; -1 where all are. Times rise.
const lastAt = (times, t) => {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle + 1; else high = middle;
  }
  return low - 1;
};

// Pose of a track between its two nearest times, or null where the track is not there. `slack` holds the ends for a moment,
// so that a road user does not flicker between two steps of the log.
const poseAt = (track, t, slack = 0) => {
  const { t: times, x, y, a } = track;
  const end = times.length - 1;
  if (end < 0 || t < times[0] - slack || t > times[end] + slack) return null;
  const i = Math.max(0, lastAt(times, t));
  if (i >= end || t <= times[i]) return { x: x[i], y: y[i], a: a[i] };
  const f = (t - times[i]) / (times[i + 1] - times[i]);
  return { x: x[i] + f * (x[i + 1] - x[i]), y: y[i] + f * (y[i + 1] - y[i]), a: a[i] + f * (a[i + 1] - a[i]) };
};

// Pose at the nearest time at which the track is there.
const heldPose = (track, t) => poseAt(track, Math.min(Math.max(t, track.t[0]), track.t.at(-1)));

const MINUS = "\u2212";
const seconds = (ms, places = 1) => (ms < 0 ? MINUS : "") + (Math.abs(ms) / 1000).toFixed(places);

// A number with about three digits, as the report prints it.
const shortNumber = (value) => {
  if (value === null || value === undefined) return "\u2013";
  const size = Math.abs(value);
  const text = size >= 100 ? size.toFixed(0) : size >= 10 ? size.toFixed(1) : size.toFixed(2);
  return (value < 0 && Number(text) !== 0 ? MINUS : "") + text;
};

const byId = (id) => document.getElementById(id);
const svgNode = (name, attributes = {}) => {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  return node;
};
const make = (name, className = "", text = "") => {
  const node = document.createElement(name);
  if (className) node.className = className;
  if (text) node.textContent = text;
  return node;
};
const variantClass = (index, renderer) => "variant-" + (Math.max(0, index.renderers.indexOf(renderer)) % 8);
