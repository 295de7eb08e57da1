"use strict";
// Metrics over time, one small chart each: a line for every renderer, broken where a value is not valid, with a bar there.

const CHART = { width: 1000, height: 100 };

class Curves {
  constructor(root, chooser, index, onSeek) {
    Object.assign(this, { root, chooser, index, onSeek, chosen: new Set(index.first_curves), charts: [] });
    this.root.addEventListener("pointerdown", (event) => this.drag(event));
    this.root.addEventListener("pointermove", (event) => { if (event.buttons & 1) this.drag(event); });
  }

  drag(event) {
    const plot = event.target.closest(".plot");
    if (!plot || !this.cell) return;
    const box = plot.getBoundingClientRect();
    this.onSeek(this.from + ((event.clientX - box.left) / box.width) * (this.to - this.from));
  }

  load(cell, from, to) {
    Object.assign(this, { cell, from, to });
    const known = new Set(cell.drives.flatMap((drive) => Object.keys(drive.curves ?? {})));
    const order = [...new Set([...this.index.first_curves, ...Object.keys(this.index.metrics)])];
    const rank = (name) => (order.includes(name) ? order.indexOf(name) : order.length);
    this.names = [...known].sort((a, b) => rank(a) - rank(b) || (a < b ? -1 : 1));
    this.chooser.replaceChildren(...this.names.map((name) => this.choice(name)));
    this.draw();
  }

  choice(name) {
    const label = make("label"), box = make("input");
    box.type = "checkbox";
    box.checked = this.chosen.has(name);
    box.addEventListener("change", () => {
      if (box.checked) this.chosen.add(name); else this.chosen.delete(name);
      this.draw();
      this.show(this.t);
    });
    label.title = [name, this.index.metrics[name]?.help].filter(Boolean).join(": ");
    label.append(box, make("span", "", this.label(name)));
    return label;
  }

  // What a metric is called; a run of an earlier version may not say.
  // A name that ends with its unit goes without it: the unit stands beside it.
  label(name) {
    const facts = this.index.metrics[name];
    const suffix = facts?.unit ? "_" + facts.unit.replace("/", "p") : "";
    const plain = suffix && name.endsWith(suffix) ? name.slice(0, -suffix.length) : name;
    return facts?.label || plain.replaceAll("_", " ");
  }

  draw() {
    this.charts = this.names.filter((name) => this.chosen.has(name)).map((name) => this.chart(name));
    this.root.replaceChildren(...this.charts.map((chart) => chart.node));
    if (!this.charts.length) this.root.append(make("p", "small muted", "No curve is chosen, or this cell has none of the chosen ones."));
    else this.root.append(this.axis());
    this.mark(this.hidden ?? new Set());
  }

  axis() {
    const axis = make("div", "axis num");
    axis.append(make("span", "", seconds(this.from) + " s"), make("span", "", seconds(this.to) + " s"));
    return axis;
  }

  chart(name) {
    const facts = this.index.metrics[name] ?? { unit: "", help: "" };
    const all = this.cell.drives.map((drive, i) => ({ i, renderer: drive.renderer, curve: drive.curves?.[name] }));
    const drives = all.filter((one) => one.curve);
    const values = drives.flatMap(({ curve }) => curve.v.filter((v) => v !== null));
    let low = facts.flag ? 0 : Math.min(...values), high = facts.flag ? 1 : Math.max(...values);
    if (!values.length) [low, high] = [0, 1];
    const least = facts.unit === "m" ? 0.2 : 0.02; // noise must not fill a chart
    if (high - low < least) [low, high] = [(low + high - least) / 2, (low + high + least) / 2];
    const margin = (high - low) * 0.06;
    const x = (t) => ((t - this.from) / (this.to - this.from)) * CHART.width;
    const y = (v) => CHART.height - ((v - low + margin) / (high - low + 2 * margin)) * CHART.height;
    const node = make("section", "curve"), head = make("header");
    const title = make("h3", "", this.label(name));
    title.title = [name, facts.help].filter(Boolean).join(": ");
    if (facts.unit) title.append(make("small", "muted", " " + facts.unit));
    const now = make("div", "now num");
    head.append(title, now);
    const plot = make("div", "plot");
    const svg = svgNode("svg", { viewBox: `0 0 ${CHART.width} ${CHART.height}`, preserveAspectRatio: "none", role: "img" });
    svg.setAttribute("aria-label", this.inWords(name, facts, drives));
    for (const [start, end] of this.unscored()) {
      svg.append(svgNode("rect", { class: "unscored", x: x(start), y: 0, width: x(end) - x(start), height: CHART.height }));
    }
    if (low < 0 && high > 0) svg.append(svgNode("line", { class: "zero", x1: 0, x2: CHART.width, y1: y(0), y2: y(0) }));
    const reads = drives.map(({ i, renderer, curve }, row) => {
      const group = svgNode("g", { class: variantClass(this.index, renderer), "data-drive": i });
      group.append(svgNode("path", { class: "line", d: linePath(curve, x, y) }));
      for (const [start, end] of invalidParts(curve)) {
        const width = Math.max(4, x(end) - x(start));
        const bar = svgNode("rect", { class: "invalid", x: x(start), width, y: CHART.height - 7 * (row + 1), height: 6 });
        bar.append(svgNode("title"));
        bar.firstChild.textContent = `${renderer}: no valid value from ${seconds(start)} to ${seconds(end)} s. ${curve.why ?? ""}`;
        group.append(bar);
      }
      svg.append(group);
      const read = make("span", variantClass(this.index, renderer));
      read.dataset.drive = String(i);
      const text = make("span");
      read.append(make("span", "swatch"), text);
      read.title = renderer;
      now.append(read);
      return { curve, text, said: "" };
    });
    plot.append(svg, make("i", "playhead"));
    // The limits stand beside the plot: a curve that reaches one would cross its number.
    const graph = make("div", "graph"), limits = make("div", "limits num");
    if (values.length) limits.append(make("span", "", shortNumber(high)), make("span", "", shortNumber(low)));
    graph.append(limits, plot);
    node.append(head, graph);
    const whys = [...new Set(drives.map(({ curve }) => curve.why).filter(Boolean))];
    if (!values.length && whys.length) node.append(make("p", "why small muted", "no valid value: " + whys.join("; ")));
    return { node, plot, reads, head: plot.querySelector(".playhead") };
  }

  // Times that do not count: before the policy drives, as the series eval_relevant of the first rollout says.
  unscored() {
    const relevant = this.cell.drives.find((drive) => drive.curves?.eval_relevant)?.curves.eval_relevant;
    if (!relevant) return [];
    const first = relevant.t[relevant.v.findIndex((v) => v !== null && v >= 0.5)];
    return first === undefined || first <= this.from ? [] : [[this.from, first]];
  }

  inWords(name, facts, drives) {
    const of = ({ renderer, curve }) => {
      const valid = curve.v.filter((v) => v !== null);
      if (!valid.length) return `${renderer}: no valid value`;
      const gaps = invalidParts(curve).length ? `, ${curve.v.length - valid.length} of ${curve.v.length} values not valid` : "";
      return `${renderer}: ${shortNumber(Math.min(...valid))} to ${shortNumber(Math.max(...valid))} ${facts.unit}${gaps}`;
    };
    return `${this.label(name)} over time. ${drives.map(of).join("; ")}`;
  }

  show(t) {
    this.t = t;
    const share = Math.min(1, Math.max(0, (t - this.from) / (this.to - this.from)));
    for (const chart of this.charts) {
      chart.head.style.transform = `translateX(${(share * chart.plot.clientWidth).toFixed(1)}px)`;
      for (const read of chart.reads) {
        const i = lastAt(read.curve.t, t);
        const text = shortNumber(i < 0 || t > read.curve.t.at(-1) + 200 ? null : read.curve.v[i]);
        if (text !== read.said) { read.said = text; read.text.textContent = text; }
      }
    }
  }

  mark(hidden) {
    this.hidden = hidden;
    for (const node of this.root.querySelectorAll("[data-drive]")) node.classList.toggle("gone", hidden.has(Number(node.dataset.drive)));
  }
}

const linePath = (curve, x, y) => {
  let path = "", open = false;
  curve.v.forEach((v, i) => {
    if (v === null) { open = false; return; }
    path += `${open ? "L" : "M"}${x(curve.t[i]).toFixed(1)} ${y(v).toFixed(1)}`;
    open = true;
  });
  return path;
};

// Stretches of time in which no value is valid, from the first such step to the one after the last.
const invalidParts = (curve) => {
  const parts = [];
  let start = null;
  curve.v.forEach((v, i) => {
    if (v === null && start === null) start = curve.t[i];
    if (v !== null && start !== null) { parts.push([start, curve.t[i]]); start = null; }
  });
  if (start !== null) parts.push([start, curve.t.at(-1)]);
  return parts;
};
