"use strict";
// The scene from above, on a canvas. The recorded drive runs from left to right, as in the report's maps. The map is painted once into a
// layer larger than the view and copied until the view leaves it; everything that moves is painted in every frame.

const LAYER = 1.5; // size of the layer over that of the view
const FOLLOW_M = 90; // metres across when the view follows the ego
const HALO = 2.5;

// What a label of a log is drawn as: simrun's and AlpaSim's words.
const kindOf = (label) => (/pedestrian|person/.test(label) ? "pedestrian" : /cyclist|rider|bicycle/.test(label) ? "cyclist" : label);
const onFoot = (label) => ["pedestrian", "cyclist"].includes(kindOf(label));

class Birdseye {
  constructor(canvas, index) {
    Object.assign(this, { canvas, index, cell: null, follow: true, zoom: 1, pan: [0, 0], layer: null, timing: [] });
    this.context = canvas.getContext("2d", { alpha: false });
    this.readColours();
    this.bindPointer();
  }

  readColours() {
    const style = getComputedStyle(document.documentElement);
    const value = (name) => style.getPropertyValue("--" + name).trim();
    this.colours = Object.fromEntries(["ground", "road", "lane-line", "edge", "crosswalk", "ink", "muted", "card"].map((n) => [n, value(n)]));
    this.variants = this.index.renderers.map((_, i) => value("variant-" + (i % 8)));
    this.layer = null;
  }

  load(cell) {
    this.cell = cell;
    const { map } = cell;
    const line = (path, [x, y], close) => {
      x.forEach((_, i) => (i ? path.lineTo(x[i], y[i]) : path.moveTo(x[i], y[i])));
      if (close) path.closePath();
      return path;
    };
    const all = (lines, close) => lines.reduce((path, one) => line(path, one, close), new Path2D());
    this.paths = {
      lanes: map.lanes.map((one) => line(new Path2D(), one, true)), // one by one: overlapping rings must not cut holes
      crosswalks: all(map.crosswalks, true), markings: all(map.markings), edges: all(map.edges), log: line(new Path2D(), map.log),
    };
    this.turn = [Math.cos(map.turn), Math.sin(map.turn)];
    this.drives = cell.drives.map((drive, i) => ({ ...drive, i, colour: this.variants[this.index.renderers.indexOf(drive.renderer)] }))
      .filter((drive) => drive.ego);
    this.bounds = this.around([map.log, ...this.drives.map((drive) => [drive.ego.x, drive.ego.y])]);
    this.pan = [0, 0];
    this.layer = null;
  }

  // Bounds on the turned page, centimetres: [x0, y0, x1, y1].
  around(lines) {
    const [c, s] = this.turn, box = [Infinity, Infinity, -Infinity, -Infinity];
    for (const [x, y] of lines) x.forEach((_, i) => {
      const u = c * x[i] + s * y[i], v = c * y[i] - s * x[i];
      box[0] = Math.min(box[0], u); box[1] = Math.min(box[1], v); box[2] = Math.max(box[2], u); box[3] = Math.max(box[3], v);
    });
    return box;
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    if (this.canvas.width !== Math.round(w * ratio) || this.canvas.height !== Math.round(h * ratio)) {
      this.canvas.width = Math.round(w * ratio);
      this.canvas.height = Math.round(h * ratio);
      this.layer = null;
    }
    this.ratio = ratio;
  }

  // Scale in device pixels a centimetre, and the centre of the view on the turned page.
  view(t, focus) {
    const [x0, y0, x1, y1] = this.bounds, [c, s] = this.turn;
    const whole = Math.min(this.canvas.width / (x1 - x0 + 2400), this.canvas.height / (y1 - y0 + 2400));
    const driven = this.drives.find((drive) => drive.i === focus) ?? this.drives[0];
    let scale = whole, centre = [(x0 + x1) / 2, (y0 + y1) / 2];
    if (this.follow && driven) {
      scale = Math.max(whole, Math.max(this.canvas.width, 480 * this.ratio) / (FOLLOW_M * 100));
      const pose = heldPose(driven.ego, t);
      centre = [c * pose.x + s * pose.y, c * pose.y - s * pose.x];
    }
    scale *= this.zoom;
    return { scale, centre: [centre[0] + this.pan[0], centre[1] + this.pan[1]] };
  }

  // Let a context draw in world centimetres around a centre; returns centimetres of one CSS pixel.
  world(context, { scale, centre }, width, height) {
    const [c, s] = this.turn;
    context.setTransform(scale * c, scale * s, scale * s, -scale * c, width / 2 - scale * centre[0], height / 2 + scale * centre[1]);
    return this.ratio / scale;
  }

  ground(view) {
    const { canvas } = this, old = this.layer;
    const shift = old && [0, 1].map((k) => Math.round((old.view.centre[k] - view.centre[k]) * view.scale));
    const room = [canvas.width, canvas.height].map((side) => (side * (LAYER - 1)) / 2);
    if (!old || old.view.scale !== view.scale || Math.abs(shift[0]) > room[0] || Math.abs(shift[1]) > room[1]) {
      this.layer = { view, canvas: this.paintLayer(view) };
      return this.ground(view);
    }
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    this.context.drawImage(old.canvas, Math.round(-room[0]) + shift[0], Math.round(-room[1]) - shift[1]);
  }

  paintLayer(view) {
    const layer = this.layer?.canvas ?? document.createElement("canvas");
    layer.width = Math.round(this.canvas.width * LAYER);
    layer.height = Math.round(this.canvas.height * LAYER);
    const context = layer.getContext("2d", { alpha: false });
    context.fillStyle = this.colours.ground;
    context.fillRect(0, 0, layer.width, layer.height);
    const px = this.world(context, view, layer.width, layer.height);
    context.fillStyle = this.colours.road;
    for (const lane of this.paths.lanes) context.fill(lane);
    context.fillStyle = this.colours.crosswalk;
    context.fill(this.paths.crosswalks);
    for (const [path, colour, width] of [["markings", "lane-line", 1.2], ["edges", "edge", 1.5]]) {
      context.strokeStyle = this.colours[colour];
      context.lineWidth = width * px;
      context.stroke(this.paths[path]);
    }
    context.strokeStyle = this.colours.ink;
    context.globalAlpha = 0.6;
    context.setLineDash([6 * px, 6 * px]);
    context.lineWidth = 1.4 * px;
    context.stroke(this.paths.log);
    return layer;
  }

  draw(t, focus, hidden) {
    if (!this.cell) return;
    const began = performance.now();
    this.resize();
    if (!this.canvas.width || !this.canvas.height) return; // not laid out yet
    const view = this.view(t, focus), { context } = this;
    this.ground(view);
    const px = this.world(context, view, this.canvas.width, this.canvas.height);
    context.lineJoin = context.lineCap = "round";
    const seen = this.drives.filter((drive) => !hidden.has(drive.i)).sort((a, b) => (a.i === focus) - (b.i === focus));
    for (const drive of seen) this.trail(drive, t, px, drive.i === focus);
    this.users(seen, t, px, focus);
    for (const drive of seen) this.plan(drive, t, px, drive.i === focus);
    for (const drive of seen) this.ego(drive, t, px, drive.i === focus);
    for (const drive of seen) this.marks(drive, t, px);
    this.scaleBar(view);
    this.note(performance.now() - began);
  }

  note(ms) { // how long the last frames took, for who measures
    this.timing.push(ms);
    if (this.timing.length > 600) this.timing.shift();
  }

  trail(drive, t, px, strong) {
    const { x, y, t: times } = drive.ego, { context } = this;
    const now = Math.max(0, lastAt(times, t)), at = heldPose(drive.ego, t);
    const stroke = (from, to, alpha, width) => {
      context.beginPath();
      for (let i = from; i <= to; i += 1) (i === from ? context.moveTo(x[i], y[i]) : context.lineTo(x[i], y[i]));
      if (from === 0) context.lineTo(at.x, at.y);
      context.globalAlpha = alpha;
      context.lineWidth = width * px;
      context.stroke();
    };
    context.strokeStyle = drive.colour;
    stroke(now, times.length - 1, 0.28, 1.2);
    stroke(0, now, strong ? 0.9 : 0.65, 2);
    context.globalAlpha = 1;
  }

  // Road users of the followed rollout are filled; those that other rollouts have elsewhere are outlined in their colour.
  users(seen, t, px, focus) {
    const { context, cell } = this, first = seen.find((drive) => drive.i === focus) ?? seen[0];
    if (!first) return;
    const filled = new Set(first.users), groups = new Map();
    const put = (key, user) => {
      const pose = poseAt(user, t, 60);
      if (pose) (groups.get(key) ?? groups.set(key, []).get(key)).push([user, pose]);
    };
    for (const i of first.users) put(cell.users[i].label, cell.users[i]);
    for (const drive of seen) for (const i of drive.users) if (!filled.has(i)) put(drive, cell.users[i]);
    for (const [key, all] of groups) {
      const own = typeof key === "string";
      context.beginPath();
      for (const [user, pose] of all) this.body(user, pose, px);
      context.globalAlpha = own ? 1 : 0.7;
      context.lineWidth = (own ? 1 : 1.2) * px;
      context.strokeStyle = own ? this.colours.card : key.colour;
      if (own) { context.fillStyle = this.colours[onFoot(key) ? "ink" : "muted"]; context.fill(); }
      context.stroke();
      if (!own) continue;
      context.beginPath(); // headings
      for (const [user, pose] of all) if (kindOf(user.label) !== "pedestrian") this.nose(user, pose);
      context.lineWidth = 1.4 * px;
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  body(user, pose, px) {
    const { context } = this, small = 3 * px; // nothing is smaller than a few pixels
    const half = Math.max(user.size[0] / 2, small), wide = Math.max(user.size[1] / 2, small);
    if (kindOf(user.label) === "pedestrian") {
      const r = Math.max(half, wide);
      context.moveTo(pose.x + r, pose.y);
      context.arc(pose.x, pose.y, r, 0, 2 * Math.PI);
      return;
    }
    const c = Math.cos(pose.a / 1000), s = Math.sin(pose.a / 1000);
    const corner = (u, v) => [pose.x + c * u - s * v, pose.y + s * u + c * v];
    context.moveTo(...corner(-half, -wide));
    for (const [u, v] of [[half, -wide], [half, wide], [-half, wide]]) context.lineTo(...corner(u, v));
    context.closePath();
  }

  nose(user, pose) {
    const { context } = this, half = user.size[0] / 2, wide = user.size[1] / 2 * 0.7;
    const c = Math.cos(pose.a / 1000), s = Math.sin(pose.a / 1000);
    const corner = (u, v) => [pose.x + c * u - s * v, pose.y + s * u + c * v];
    context.moveTo(...corner(half - wide * 1.6, -wide));
    context.lineTo(...corner(half - wide * 0.5, 0));
    context.lineTo(...corner(half - wide * 1.6, wide));
  }

  plan(drive, t, px, strong) {
    const { context } = this, i = t > drive.ego.t.at(-1) ? -1 : lastAt(this.planTimes(drive), t);
    if (i < 0) return;
    const line = ([x, y]) => x.forEach((_, k) => (k ? context.lineTo(x[k], y[k]) : context.moveTo(x[k], y[k])));
    const [plan, ...samples] = drive.plans[i].lines;
    context.strokeStyle = drive.colour;
    if (strong && samples.length) {
      context.beginPath();
      samples.forEach(line);
      context.globalAlpha = 0.35;
      context.lineWidth = px;
      context.stroke();
    }
    context.beginPath();
    line(plan);
    context.globalAlpha = strong ? 1 : 0.75;
    context.lineWidth = (strong ? 3 : 2) * px;
    context.setLineDash([7 * px, 5 * px]);
    context.stroke();
    context.setLineDash([]);
    context.fillStyle = drive.colour;
    context.beginPath(); // a dot for every second: points are half a second apart
    for (let k = 2; k < plan[0].length; k += 2) {
      context.moveTo(plan[0][k], plan[1][k]);
      context.arc(plan[0][k], plan[1][k], 3 * px, 0, 7);
    }
    context.fill();
    context.globalAlpha = 1;
  }

  planTimes(drive) {
    drive.planTimes ??= drive.plans.map((plan) => plan.t);
    return drive.planTimes;
  }

  ego(drive, t, px, strong) {
    const { context } = this, pose = heldPose(drive.ego, t), car = { label: "ego", size: drive.size };
    context.globalAlpha = t > drive.ego.t.at(-1) ? 0.5 : 1;
    context.beginPath();
    this.body(car, pose, px);
    context.strokeStyle = this.colours.card;
    context.lineWidth = HALO * 2 * px;
    context.stroke();
    context.fillStyle = drive.colour;
    context.fill();
    context.strokeStyle = strong ? this.colours.ink : drive.colour;
    context.lineWidth = 1.5 * px;
    context.stroke();
    context.strokeStyle = this.colours.card;
    context.lineWidth = 2 * px;
    context.beginPath();
    this.nose(car, pose);
    context.stroke();
    context.globalAlpha = 1;
  }

  // Collisions are round and other events of the ego square, as in the report; faint before they happen.
  marks(drive, t, px) {
    const { context } = this, r = 6 * px;
    for (const moment of drive.moments) {
      if (moment.t === null || ["frame", "plans"].includes(moment.kind)) continue;
      const { x, y } = heldPose(drive.ego, moment.t);
      context.globalAlpha = t >= moment.t ? 1 : 0.3;
      context.beginPath();
      if (moment.kind === "collision") context.arc(x, y, r, 0, 7); else context.rect(x - r, y - r, 2 * r, 2 * r);
      context.lineWidth = 5 * px;
      context.strokeStyle = this.colours.card;
      context.stroke();
      context.lineWidth = 2.2 * px;
      context.strokeStyle = drive.colour;
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  scaleBar({ scale }) {
    const { context, ratio } = this, width = this.canvas.width / ratio;
    const cm = [1, 2, 5, 10, 20, 50, 100, 200, 500].map((m) => m * 100).find((one) => (one * scale) / ratio > width * 0.07) ?? 100000;
    const long = (cm * scale) / ratio, y = this.canvas.height / ratio - 14;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.fillStyle = context.strokeStyle = this.colours.ink;
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(14, y - 4); context.lineTo(14, y); context.lineTo(14 + long, y); context.lineTo(14 + long, y - 4);
    context.stroke();
    context.font = "12px system-ui, sans-serif";
    context.fillText(cm / 100 + " m", 18, y - 5);
  }

  bindPointer() {
    let last = null;
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      last = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!last || !this.layer) return;
      const cm = this.ratio / this.layer.view.scale;
      this.pan = [this.pan[0] - (event.clientX - last[0]) * cm, this.pan[1] + (event.clientY - last[1]) * cm];
      last = [event.clientX, event.clientY];
      this.onView?.();
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { last = null; });
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey && !canvas.matches(":focus")) return; // a page that scrolls goes on scrolling
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY * 0.0015));
    }, { passive: false });
  }

  zoomBy(factor) {
    this.zoom = Math.min(12, Math.max(0.2, this.zoom * factor));
    this.onView?.();
  }

  setFollow(follow) {
    Object.assign(this, { follow, zoom: 1, pan: [0, 0] });
    this.onView?.();
  }
}
