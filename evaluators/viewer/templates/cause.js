"use strict";
// The page of a cause: a query of the policy at a time, its picture behind every renderer, and what is drawn over it.

const why = {
  data: JSON.parse(byId("cause").textContent), i: 0, wanted: new Set(),

  start() {
    const { data } = this, { looks } = data, scrub = byId("scrub");
    this.drive = data.drives.find((drive) => drive.renderer === data.own);
    document.addEventListener("keydown", (event) => this.key(event));
    for (const button of document.querySelectorAll("[data-copy]")) button.addEventListener("click", () => this.copy(button));
    if (!looks.length || !data.lens) return;
    const boxes = [...document.querySelectorAll("#layers input")];
    const read = () => { this.wanted = new Set(boxes.filter((one) => one.checked).map((one) => one.value)); };
    boxes.forEach((one) => one.addEventListener("change", () => { read(); this.show(this.i); }));
    read();
    this.stages = [...document.querySelectorAll("figure[data-renderer]")].map((figure) => ({ name: figure.dataset.renderer, canvas: figure.querySelector("canvas"), said: figure.querySelector("small") }));
    scrub.max = String(looks.length - 1);
    scrub.addEventListener("input", () => this.show(Number(scrub.value)));
    byId("before").addEventListener("click", () => this.show(this.i - 1));
    byId("after").addEventListener("click", () => this.show(this.i + 1));
    const first = data.failed === null ? looks.length - 1 : looks.findLastIndex((look) => look.t <= data.failed - 800);
    this.show(Math.max(0, first));
  },

  show(i) {
    const { data } = this;
    this.i = Math.max(0, Math.min(data.looks.length - 1, i));
    const look = data.looks[this.i];
    byId("scrub").value = String(this.i);
    const before = data.failed === null ? "" : look.t <= data.failed ? `, ${seconds(data.failed - look.t)} s before the failure` : ", after the failure";
    byId("when").textContent = `${seconds(look.t)} s${before}; ${look.speed} m/s`;
    byId("scrub").setAttribute("aria-valuetext", byId("when").textContent);
    this.drawn = Promise.all(this.stages.map((stage) => this.draw(stage, look, this.i)));
    this.tell(look);
  },

  async draw({ name, canvas, said }, look, i) {
    const seen = look.seen[name];
    if (!seen) return;
    const picture = await load("jpeg", seen.jpeg), heat = name === this.data.own && this.wanted.has("policy") ? await Promise.all(look.said.heat.map(([, png]) => load("png", png))) : [];
    if (this.i !== i) return;
    Object.assign(canvas, { width: picture.width, height: picture.height });
    const context = canvas.getContext("2d");
    context.drawImage(picture, 0, 0);
    for (const one of heat) context.drawImage(one, 0, 0, canvas.width, canvas.height);
    const overlay = new Overlay(context, this.data.lens, this.drive.rear), { wanted } = this;
    overlay.at(heldPose(this.drive.ego, seen.t));
    overlay.scene(this.data, this.drive.users, seen.t, wanted);
    if (wanted.has("route")) overlay.lines([look.route], { colour: "#6ee787", width: 3, dash: [2, 6] });
    const plan = look.plans[name];
    if (plan && wanted.has("plan")) overlay.plan(plan.lines, name === this.data.own ? "#2f81f7" : "#f0883e", wanted.has("samples"));
    if (name === this.data.own && wanted.has("policy")) this.own(context, overlay, look.said);
    if (said) said.textContent = plan ? this.apart(look, name) : "";
  },

  own(context, overlay, said) {
    overlay.lines(said.lines.map(([, line]) => line), { colour: "#d2a8ff", width: 2 });
    Object.assign(context, { strokeStyle: "#ff7b72", fillStyle: "#ff7b72", lineWidth: 2, font: "12px system-ui, sans-serif" });
    for (const [name, x0, y0, x1, y1] of said.boxes) {
      context.strokeRect(x0, y0, x1 - x0, y1 - y0);
      context.fillText(name.replace(/^boxes[_ ]?/, ""), x0 + 2, Math.max(11, y0 - 3));
    }
  },

  // How far the plan behind another renderer ends from the own one, two seconds ahead.
  apart(look, name) {
    const [one, other] = [look.plans[this.data.own].lines[0], look.plans[name].lines[0]], k = Math.min(4, one[0].length - 1, other[0].length - 1);
    return name === this.data.own || k < 0 ? "" : `plan ${(Math.hypot(one[0][k] - other[0][k], one[1][k] - other[1][k]) / 100).toFixed(2)} m apart, 2 s ahead`;
  },

  tell(look) {
    const rows = [...look.said.text, ...look.said.heat.map(([name, , low, high]) => [name, `heat map from ${low} to ${high}`])];
    byId("said").replaceChildren(...rows.flatMap(([name, text]) => [make("dt", "", name), make("dd", "num", text)]));
    byId("own-pictures").replaceChildren(...look.said.images.map(([name, jpeg]) => {
      const figure = make("figure"), image = make("img");
      Object.assign(image, { src: "data:image/jpeg;base64," + jpeg, alt: name });
      figure.append(image, make("figcaption", "small muted", name));
      return figure;
    }));
    byId("says-nothing").hidden = rows.length + look.said.images.length + look.said.boxes.length + look.said.lines.length > 0;
  },

  async copy(button) {
    try { await navigator.clipboard.writeText(button.dataset.copy); button.textContent = "Copied"; } catch { button.textContent = "Select and copy it"; }
  },

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches?.("input[type=checkbox]")) return;
    const button = document.querySelector(`[data-key="${CSS.escape(event.key)}"]`);
    if (button) { button.scrollIntoView({ block: "nearest" }); this.copy(button); }
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step && this.stages && event.target.id !== "scrub") { event.preventDefault(); this.show(this.i + step); }
  },
};

const load = (kind, data) => createImageBitmap(new Blob([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))], { type: "image/" + kind }));

why.start();
