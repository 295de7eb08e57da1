"use strict";
// The page of a cause: a query of the policy at a time, its image behind every renderer, and what is drawn over it.

const why = {
  data: JSON.parse(byId("cause").textContent), i: 0, wanted: new Set(),

  start() {
    const { data } = this, { queries } = data, scrub = byId("scrub");
    document.addEventListener("keydown", (event) => this.key(event));
    for (const button of document.querySelectorAll("[data-copy]")) button.addEventListener("click", () => this.copy(button));
    if (!data.drive) return;
    this.charts = data.curves.map((curve) => chart(curve, data.failed, data.span));
    byId("curves").replaceChildren(...this.charts.map(({ node }) => node));
    this.above = new Birdseye(byId("above"), { renderers: [data.own] });
    this.above.load({ map: data.map, users: data.users, drives: [data.drive] });
    this.above.onView = () => this.look();
    new ResizeObserver(() => this.look()).observe(byId("above"));
    byId("theme").addEventListener("click", () => { this.above.readColours(); this.look(); });
    if (!queries.length) { this.look(); return; }
    const boxes = [...document.querySelectorAll("#layers input")];
    const read = () => { this.wanted = new Set(boxes.filter((one) => one.checked).map((one) => one.value)); };
    boxes.forEach((one) => one.addEventListener("change", () => { read(); this.show(this.i); }));
    read();
    this.stages = [...document.querySelectorAll("figure[data-renderer]")].map((figure) => ({ name: figure.dataset.renderer, canvas: figure.querySelector("canvas"), said: figure.querySelector("small") }));
    scrub.max = String(queries.length - 1);
    scrub.addEventListener("input", () => this.show(Number(scrub.value)));
    byId("before").addEventListener("click", () => this.show(this.i - 1));
    byId("after").addEventListener("click", () => this.show(this.i + 1));
    const first = data.failed === null ? queries.length - 1 : queries.findLastIndex((query) => query.t <= data.failed - 800);
    this.show(Math.max(0, first));
  },

  // The view from above and the marks in the curves, at the chosen query or else at the failure.
  look() {
    const { data } = this, t = data.queries[this.i]?.t ?? data.failed ?? data.drive.ego.t.at(-1);
    this.above.draw(t, 0, new Set());
    for (const { head } of this.charts) head.setAttribute("transform", `translate(${share(t, data.span).toFixed(1)} 0)`);
  },

  show(i) {
    const { data } = this;
    this.i = Math.max(0, Math.min(data.queries.length - 1, i));
    const query = data.queries[this.i];
    byId("scrub").value = String(this.i);
    const before = data.failed === null ? "" : query.t <= data.failed ? `, ${seconds(data.failed - query.t)} s before the failure` : ", after the failure";
    byId("when").textContent = `${seconds(query.t)} s${before}; ${query.speed} m/s`;
    byId("scrub").setAttribute("aria-valuetext", byId("when").textContent);
    this.look();
    this.drawn = Promise.all(this.stages.map((stage) => this.draw(stage, query, this.i)));
    this.tell(query);
  },

  async draw({ name, canvas, said }, query, i) {
    const seen = query.seen[name];
    if (said) said.textContent = seen ? "" : "stored for the last second before the failure";
    canvas.hidden = !seen;
    if (!seen) return;
    const image = await load("jpeg", seen.jpeg), heat = name === this.data.own && this.wanted.has("policy") ? await Promise.all(query.said.heat.map(([, png]) => load("png", png))) : [];
    if (this.i !== i) return;
    Object.assign(canvas, { width: image.width, height: image.height });
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    for (const one of heat) context.drawImage(one, 0, 0, canvas.width, canvas.height);
    const { wanted } = this, isOwn = name === this.data.own && wanted.has("policy");
    if (isOwn) this.boxes(context, query.said);
    if (!this.data.lens) return;
    const overlay = new Overlay(context, this.data.lens, this.data.rear);
    overlay.at(heldPose(this.data.ego, seen.t));
    overlay.scene(this.data, this.data.users.keys(), seen.t, wanted);
    if (wanted.has("route")) overlay.lines([query.route], { colour: "#6ee787", width: 3, dash: [2, 6] });
    if (wanted.has("plan")) overlay.plan(query.plan, "#2f81f7", wanted.has("samples"));
    if (isOwn) overlay.lines(query.said.lines.map(([, line]) => line), { colour: "#d2a8ff", width: 2 });
  },

  // What the policy marks in the image itself, in its pixels.
  boxes(context, said) {
    Object.assign(context, { strokeStyle: "#ff7b72", fillStyle: "#ff7b72", lineWidth: 2, font: "12px system-ui, sans-serif" });
    for (const [name, x0, y0, x1, y1] of said.boxes) {
      context.strokeRect(x0, y0, x1 - x0, y1 - y0);
      context.fillText(name.replace(/^boxes[_ ]?/, ""), x0 + 2, Math.max(11, y0 - 3));
    }
  },

  tell(query) {
    const rows = [...query.said.text, ...query.said.heat.map(([name, , low, high]) => [name, `heat map from ${low} to ${high}`])];
    byId("said").replaceChildren(...rows.flatMap(([name, text]) => [make("dt", "", name), make("dd", "num", text)]));
    const figures = (images) => images.map(([name, jpeg]) => {
      const figure = make("figure"), image = make("img");
      Object.assign(image, { src: "data:image/jpeg;base64," + jpeg, alt: name });
      figure.append(image, make("figcaption", "small muted", name));
      return figure;
    });
    byId("beside").replaceChildren(...figures(query.beside));
    byId("own-images").replaceChildren(...figures(query.said.images));
    byId("says-nothing").hidden = rows.length + query.said.images.length + query.said.boxes.length + query.said.lines.length > 0;
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

const PLOT = { width: 1000, height: 100 };
const share = (t, [from, to]) => ((t - from) / (to - from)) * PLOT.width;

// One quantity over time: lines of t (ms) and v, the failure as a red line, and a mark at the chosen query.
const chart = ({ name, unit, lines, text }, failed, span) => {
  const values = lines.flatMap(({ v }) => v.filter((one) => one !== null));
  let low = Math.min(0, ...values), high = Math.max(0, ...values);
  if (high - low < 0.5) high = low + 0.5;
  const margin = 0.06 * (high - low);
  const y = (v) => PLOT.height - ((v - low + margin) / (high - low + 2 * margin)) * PLOT.height;
  const svg = svgNode("svg", { viewBox: `0 0 ${PLOT.width} ${PLOT.height}`, preserveAspectRatio: "none", role: "img", "aria-label": text });
  svg.append(svgNode("line", { class: "zero", x1: 0, x2: PLOT.width, y1: y(0), y2: y(0) }));
  if (failed !== null) svg.append(svgNode("line", { class: "failed", x1: share(failed, span), x2: share(failed, span), y1: 0, y2: PLOT.height }));
  const head = svg.appendChild(svgNode("line", { class: "head", x1: 0, x2: 0, y1: 0, y2: PLOT.height }));
  for (const line of lines) svg.append(svgNode("path", { class: `line ${line.kind}`, d: linePath(line, (t) => share(t, span), y) }));
  const node = make("figure", "curve"), plot = make("div", "plot"), caption = make("figcaption", "small");
  const graph = make("div", "graph"), limits = make("div", "limits num");
  limits.append(make("span", "", shortNumber(high)), make("span", "", shortNumber(low)));
  plot.append(svg);
  graph.append(limits, plot);
  caption.append(make("b", "", name), make("span", "muted", unit), ...lines.map((line) => make("span", `line-name ${line.kind}`, line.name)));
  node.append(caption, graph);
  return { node, head };
};

const load = (kind, data) => createImageBitmap(new Blob([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))], { type: "image/" + kind }));

why.start();
