"use strict";
// Lines on the road and boxes of road users, projected into a camera image. The ground is the plane on which the ego stands.

const REACH_CM = 9000, PIECE_RAD = 0.03, CUTS = 24;
const between = (p, q, share) => p.map((v, k) => v + share * (q[k] - v));

class Overlay {
  // lens: as lens.js reads it, with T: rig from camera, 3 rows of 4; rear: from the rear axle to the box centre, cm.
  constructor(context, lens, rear) {
    Object.assign(this, { context, lens, rear });
  }

  at({ x, y, a }) { // the pose of the ego's box centre
    const c = Math.cos(a / 1000), s = Math.sin(a / 1000);
    Object.assign(this, { c, s, x: x - this.rear * c, y: y - this.rear * s });
  }

  // World centimetres and height in metres -> metres before the camera: right, down, forward.
  camera(x, y, z = 0) {
    const dx = (x - this.x) / 100, dy = (y - this.y) / 100, { T } = this.lens;
    const p = [this.c * dx + this.s * dy - T[3], this.c * dy - this.s * dx - T[7], z - T[11]];
    return [0, 1, 2].map((k) => T[k] * p[0] + T[4 + k] * p[1] + T[8 + k] * p[2]);
  }

  // Add a segment to the path, as far as the camera shows it: through a pinhole straight, through another lens in short pieces.
  segment(p, q) {
    if (this.lens.kind !== "pinhole") { this.curve(p, q); return; }
    if (p[2] < NEAR_M && q[2] < NEAR_M) return;
    const cut = (one, other) => (one[2] >= NEAR_M ? one : between(one, other, (NEAR_M - one[2]) / (other[2] - one[2])));
    this.context.moveTo(...pixelOf(this.lens, cut(p, q)));
    this.context.lineTo(...pixelOf(this.lens, cut(q, p)));
  }

  // Pieces that the camera sees under equal angles; one that the lens shows in part is cut where it ends.
  curve(p, q) {
    const far = Math.hypot(...p), away = Math.hypot(...q), cross = Math.hypot(p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]);
    const whole = Math.atan2(cross, p[0] * q[0] + p[1] * q[1] + p[2] * q[2]), count = Math.max(1, Math.ceil(whole / PIECE_RAD));
    let before = p, shown = pixelOf(this.lens, p);
    if (shown) this.context.moveTo(...shown);
    for (let k = 1; k <= count; k += 1) {
      const a = (whole * k) / count, here = far * Math.sin(a), there = away * Math.sin(whole - a);
      const point = k === count ? q : between(p, q, here / (here + there)), pixel = pixelOf(this.lens, point);
      if (shown && pixel) this.context.lineTo(...pixel);
      else if (shown) this.context.lineTo(...this.lastShown(before, point));
      else if (pixel) { this.context.moveTo(...this.lastShown(point, before)); this.context.lineTo(...pixel); }
      [before, shown] = [point, pixel];
    }
  }

  // The last pixel on the way from a point that the lens shows to one that it does not.
  lastShown(from, to) {
    let [low, high] = [0, 1];
    for (let k = 0; k < CUTS; k += 1) {
      const middle = (low + high) / 2;
      if (pixelOf(this.lens, between(from, to, middle))) low = middle; else high = middle;
    }
    return pixelOf(this.lens, between(from, to, low));
  }

  line([xs, ys], close = false) {
    const near = (i) => Math.abs(xs[i] - this.x) < REACH_CM && Math.abs(ys[i] - this.y) < REACH_CM;
    for (let i = close ? 0 : 1; i < xs.length; i += 1) {
      const j = i ? i - 1 : xs.length - 1;
      if (near(i) || near(j)) this.segment(this.camera(xs[j], ys[j]), this.camera(xs[i], ys[i]));
    }
  }

  lines(all, { colour, width = 1.5, dash = [], alpha = 1, close = false }) {
    const { context } = this;
    context.beginPath();
    for (const one of all) this.line(one, close);
    Object.assign(context, { strokeStyle: colour, lineWidth: width, globalAlpha: alpha, lineJoin: "round", lineCap: "round" });
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
  }

  // A plan: a line with a dot for every second; its points are half a second apart.
  plan([line, ...samples], colour, withSamples) {
    if (withSamples && samples.length) this.lines(samples, { colour, width: 1, alpha: 0.55 });
    this.lines([line], { colour: "#fff", width: 5, alpha: 0.8 });
    this.lines([line], { colour, width: 3 });
    const { context } = this;
    context.fillStyle = colour;
    for (let k = 2; k < line[0].length; k += 2) {
      const pixel = pixelOf(this.lens, this.camera(line[0][k], line[1][k]));
      if (!pixel) continue;
      context.beginPath();
      context.arc(...pixel, 4, 0, 7);
      context.fill();
    }
  }

  box(user, pose, colour) {
    const [half, wide] = [user.size[0] / 2, user.size[1] / 2], high = (user.size[2] ?? 160) / 100, c = Math.cos(pose.a / 1000), s = Math.sin(pose.a / 1000);
    const corner = (u, v, z) => this.camera(pose.x + c * u - s * v, pose.y + s * u + c * v, z);
    const ring = [[-half, -wide], [half, -wide], [half, wide], [-half, wide]];
    if (Math.hypot(pose.x - this.x, pose.y - this.y) > REACH_CM) return;
    this.context.beginPath();
    ring.forEach(([u, v], i) => {
      const [a, b] = ring[(i + 1) % 4];
      for (const z of [0, high]) this.segment(corner(u, v, z), corner(a, b, z));
      this.segment(corner(u, v, 0), corner(u, v, high));
    });
    Object.assign(this.context, { strokeStyle: colour, lineWidth: 1.5 });
    this.context.stroke();
  }

  // What a map and road users give: `wanted` names the layers.
  scene(cell, users, t, wanted) {
    if (wanted.has("lanes")) {
      this.lines(cell.map.markings, { colour: "#ffe14d", width: 1.2, alpha: 0.9 });
      this.lines(cell.map.edges, { colour: "#ff7ad9", width: 1.4, alpha: 0.9 });
    }
    if (wanted.has("recorded")) this.lines([cell.map.log], { colour: "#fff", width: 2, dash: [7, 6] });
    if (wanted.has("users")) for (const i of users) {
      const pose = poseAt(cell.users[i], t, 60);
      if (pose) this.box(cell.users[i], pose, "#5cf2ff");
    }
  }
}
