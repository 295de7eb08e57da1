"use strict";
// Camera frames: JPEG in base64, decoded shortly before they are shown, and forgotten again.

const AHEAD = 10; // frames decoded before they are due
const KEPT = 48; // decoded frames kept a camera

class Camera {
  // over(context, t): draws over the frame of time t.
  constructor(canvas, frames, over) {
    this.canvas = canvas;
    this.over = over;
    this.frames = frames;
    this.decoded = new Map(); // index -> ImageBitmap, or a promise of one
    this.wanted = -1;
    this.shown = -1;
    canvas.width = frames.width;
    canvas.height = frames.height;
    this.context = canvas.getContext("2d", { alpha: false });
  }

  // Show the newest frame that is not after t. Resolves once it stands on the canvas.
  async show(t) {
    const i = lastAt(this.frames.t, t);
    this.canvas.dataset.wanted = String(i < 0 ? "" : this.frames.t[i]);
    if (i === this.wanted && !this.stale) return;
    this.wanted = i;
    this.stale = false;
    if (i < 0) { this.clear(); return; }
    for (let k = i; k < Math.min(i + AHEAD, this.frames.t.length); k += 1) this.decode(k);
    const image = await this.decode(i);
    if (this.wanted !== i) return; // a newer frame is due by now
    this.context.drawImage(image, 0, 0);
    this.over(this.context, this.frames.t[i]);
    this.shown = i;
    this.canvas.dataset.shown = String(this.frames.t[i]);
    this.forget(i);
  }

  decode(i) {
    if (!this.decoded.has(i)) {
      const bytes = Uint8Array.from(atob(this.frames.jpeg[i]), (c) => c.charCodeAt(0));
      this.decoded.set(i, createImageBitmap(new Blob([bytes], { type: "image/jpeg" })));
    }
    return this.decoded.get(i);
  }

  forget(i) {
    for (const [k, image] of this.decoded) {
      if (this.decoded.size <= KEPT) return;
      if (k < i || k > i + AHEAD) { this.decoded.delete(k); image.then((one) => one.close()); }
    }
  }

  clear() {
    this.context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    this.shown = -1;
    this.canvas.dataset.shown = "";
  }

  close() {
    for (const image of this.decoded.values()) image.then((one) => one.close());
    this.decoded.clear();
  }
}

// Tint every cell of a image: blue as far as it is recorded frames, orange as far as the fixer made it up. The text is that of fixers/trust.py.
function drawTrust(context, text) {
  if (!text) return;
  const [size, digits] = text.split(":"), [columns, rows] = size.split("x").map(Number), { width, height } = context.canvas;
  const share = (k) => parseInt(digits[k], 16) / 15;
  for (let k = 0; k < rows * columns; k += 1) {
    const x = Math.round((k % columns) * width / columns), y = Math.round(Math.floor(k / columns) * height / rows);
    const w = Math.round(((k % columns) + 1) * width / columns) - x, h = Math.round((Math.floor(k / columns) + 1) * height / rows) - y;
    for (const [rgb, s] of [["30,110,255", share(2 * k)], ["255,120,0", share(2 * k + 1)]]) {
      context.fillStyle = `rgba(${rgb},${(0.6 * s).toFixed(3)})`;
      context.fillRect(x, y, w, h);
    }
  }
}

// The row of cameras: one figure for each renderer of the cell.
class Cameras {
  constructor(root, index, onFocus, onToggle) {
    Object.assign(this, { root, index, onFocus, onToggle, shown: [], layers: new Set(["plan"]) });
  }

  setLayers(names) {
    this.layers = new Set(names);
    for (const one of this.shown) if (one.camera) one.camera.stale = true;
  }

  hasTrust() { return this.shown.some((one) => one.camera?.frames.trust); }

  // Draw what belongs over a frame of time t: the plan in force, and on request the map and the road users, or where the image comes from.
  over(cell, drive, i, frames, context, t) {
    const { lens } = frames;
    if (this.layers.has("trust")) { drawTrust(context, frames.trust?.[lastAt(frames.t, t)]); return; }
    if (!lens || !this.layers.size) return;
    const overlay = new Overlay(context, lens, drive.rear), colour = getComputedStyle(document.documentElement).getPropertyValue(`--${variantClass(this.index, drive.renderer)}`).trim();
    overlay.at(heldPose(drive.ego, t));
    overlay.scene(cell, drive.users, t, this.layers);
    drive.planTimes ??= drive.plans.map((plan) => plan.t);
    const k = lastAt(drive.planTimes, t);
    if (k >= 0) overlay.plan(drive.plans[k].lines, colour, this.layers.has("samples"));
  }

  load(cell, outcomes, cameraName) {
    this.shown.forEach((one) => one.camera?.close());
    this.root.replaceChildren();
    this.shown = cell.drives.map((drive, i) => this.figure(drive, i, outcomes[drive.renderer] ?? "", cameraName, cell));
    this.root.dataset.count = String(cell.drives.length);
    this.root.classList.toggle("bare", this.shown.every((one) => !one.camera)); // words alone need no room for images
  }

  figure(drive, i, outcome, cameraName, cell) {
    const figure = make("figure", "camera " + variantClass(this.index, drive.renderer));
    const head = make("figcaption");
    const focus = make("button", "focus");
    focus.type = "button";
    focus.title = drive.renderer + ": follow this drive, and show its samples and road users" + (i < 9 ? " (" + (i + 1) + ")" : "");
    focus.append(make("span", "swatch"), make("b", "name", drive.renderer));
    focus.addEventListener("click", () => this.onFocus(i));
    const said = make("span", "outcome" + (outcome === "no event" ? "" : " bad"), outcome);
    said.title = outcome;
    const eye = make("button", "eye", "Hide");
    eye.type = "button";
    eye.setAttribute("aria-pressed", "false");
    eye.setAttribute("aria-label", "Hide " + drive.renderer);
    eye.addEventListener("click", () => this.onToggle(i));
    head.append(focus, said, eye);
    const stage = make("div", "stage");
    figure.append(head, stage);
    const frames = (drive.cameras ?? []).find((one) => one.name === cameraName) ?? drive.cameras?.[0];
    let camera = null;
    if (frames?.t.length) {
      const canvas = make("canvas");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", "Camera " + frames.name + " behind " + drive.renderer);
      stage.append(canvas);
      camera = new Camera(canvas, frames, (context, t) => this.over(cell, drive, i, frames, context, t));
    } else {
      const why = drive.failed ? "Nothing to show. " + drive.failed : drive.no_frames || "No camera frames.";
      stage.append(make("p", "none", why));
    }
    const ended = make("span", "ended");
    ended.hidden = true;
    stage.append(ended);
    this.root.append(figure);
    return { figure, focus, eye, camera, ended, end: drive.ego ? drive.ego.t.at(-1) : null };
  }

  // Resolves once every camera shows its frame of t.
  show(t) {
    return Promise.all(this.shown.map((one) => {
      const over = one.end !== null && t > one.end;
      if (one.ended.hidden === over) {
        one.ended.hidden = !over;
        one.ended.textContent = over ? "ended at " + seconds(one.end) + " s" : "";
      }
      return one.camera?.show(t);
    }));
  }

  mark(focus, hidden) {
    this.shown.forEach((one, i) => {
      one.focus.setAttribute("aria-pressed", String(i === focus));
      one.figure.classList.toggle("focused", i === focus);
      one.figure.classList.toggle("off", hidden.has(i));
      one.eye.setAttribute("aria-pressed", String(hidden.has(i)));
      one.eye.textContent = hidden.has(i) ? "Show" : "Hide";
    });
  }
}
