"use strict";
// Maps from above: what each rollout of a scene drove, on one canvas a scene. The recorded drive runs from left to right.
(() => {
  const maps = JSON.parse(document.getElementById("maps")?.content.textContent ?? "[]");
  const canvases = [...document.querySelectorAll("canvas[data-map]")];
  const hidden = new Set();
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const MARGIN = 1000, STRAY = 4000; // centimetres around what is shown, and how far from the recorded drive a rollout is followed
  const DASHES = [[], [7, 4], [2, 4]];

  // Bounds on the turned page, centimetres: the recorded drive, and the rollouts as far as they stay near it.
  const boundsOf = ({ map, tracks }) => {
    const [c, s] = [Math.cos(map.turn), Math.sin(map.turn)];
    const around = (lines) => {
      const us = lines.flatMap(([x, y]) => x.map((_, i) => c * x[i] + s * y[i])), vs = lines.flatMap(([x, y]) => x.map((_, i) => c * y[i] - s * x[i]));
      const least = (values) => values.reduce((a, b) => Math.min(a, b)), most = (values) => values.reduce((a, b) => Math.max(a, b));
      return [least(us), least(vs), most(us), most(vs)];
    };
    const log = around([map.log]), all = around([map.log, ...tracks.map((track) => track.line)]);
    const box = log.map((side, i) => (i < 2 ? Math.max(all[i], side - STRAY) - MARGIN : Math.min(all[i], side + STRAY) + MARGIN));
    const lacking = 0.12 * (box[2] - box[0]) - (box[3] - box[1]);
    if (lacking > 0) { box[1] -= lacking / 2; box[3] += lacking / 2; }
    return box;
  };

  const draw = (canvas) => {
    const scene = maps[canvas.dataset.map], { map } = scene, context = canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1, [x0, y0, x1, y1] = scene.bounds;
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round((canvas.width * (y1 - y0)) / (x1 - x0));
    if (!canvas.width) return; // folded
    const scale = canvas.width / (x1 - x0), px = ratio / scale, [c, s] = [Math.cos(map.turn), Math.sin(map.turn)];
    context.setTransform(scale * c, scale * s, scale * s, -scale * c, -scale * x0, scale * y1);
    context.lineJoin = context.lineCap = "round";
    const trace = ([x, y], close) => {
      context.beginPath();
      x.forEach((_, i) => (i ? context.lineTo(x[i], y[i]) : context.moveTo(x[i], y[i])));
      if (close) context.closePath();
    };
    const stroke = (name, width, alpha = 1, dash = []) => {
      Object.assign(context, { strokeStyle: name, lineWidth: width * px, globalAlpha: alpha });
      context.setLineDash(dash.map((length) => length * px));
      context.stroke();
      context.setLineDash([]);
      context.globalAlpha = 1;
    };
    const box = ({ x, y, a, size: [length, width] }) => {
      const [u, v] = [Math.cos(a / 1000) / 2, Math.sin(a / 1000) / 2];
      const corners = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([i, j]) => [x + i * length * u - j * width * v, y + i * length * v + j * width * u]);
      trace([corners.map(([cx]) => cx), corners.map(([, cy]) => cy)], true);
    };
    for (const [kind, name] of [["lanes", "road"], ["crosswalks", "crosswalk"]]) {
      context.fillStyle = colour(name);
      for (const ring of map[kind]) { trace(ring, true); context.fill(); }
    }
    for (const [kind, name, width] of [["markings", "lane-line", 1.1], ["edges", "edge", 1.4]]) for (const line of map[kind]) { trace(line); stroke(colour(name), width); }
    for (const user of scene.users) {
      if (user.way) { trace(user.way); stroke(colour("muted"), 1, 0.55); }
      box(user);
      Object.assign(context, { fillStyle: colour("muted"), globalAlpha: 0.5 });
      context.fill();
      stroke(colour("muted"), 1);
    }
    trace(map.log);
    stroke(colour("ink"), 1.8, 0.75, [5, 5]);
    const shown = (one) => !hidden.has(String(one.colour % 8));
    for (const track of scene.tracks.filter(shown)) { trace(track.line); stroke(colour("variant-" + (track.colour % 8)), 2, 0.85, DASHES[track.dash % 3]); }
    for (const mark of scene.marks.filter((one) => shown(one) && one.size)) {
      const own = colour("variant-" + (mark.colour % 8)), r = 4 * px;
      box(mark);
      stroke(own, 1.3);
      context.beginPath();
      if (mark.kind === "collision") context.arc(mark.x, mark.y, r, 0, 7); else context.rect(mark.x - r, mark.y - r, 2 * r, 2 * r);
      for (const [name, width] of [["ink", 6], ["card", 3.5]]) stroke(colour(name), width);
      context.fillStyle = own;
      context.fill();
    }
    const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500].find((one) => one * 100 * scale > canvas.width * 0.08) ?? 1000;
    const long = (metres * 100 * scale) / ratio, bottom = canvas.height / ratio - 8;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    Object.assign(context, { strokeStyle: colour("ink"), fillStyle: colour("ink"), lineWidth: 1.2, font: "12px system-ui, sans-serif" });
    context.beginPath();
    context.moveTo(12, bottom - 5); context.lineTo(12, bottom); context.lineTo(12 + long, bottom); context.lineTo(12 + long, bottom - 5);
    context.stroke();
    context.fillText(metres + " m", 16, bottom - 4);
  };

  const redraw = () => canvases.forEach(draw);
  for (const canvas of canvases) {
    const scene = maps[canvas.dataset.map];
    const box = scene.bounds = boundsOf(scene);
    canvas.closest(".view").classList.toggle("wide", box[3] - box[1] < 0.45 * (box[2] - box[0]));
    new ResizeObserver(() => draw(canvas)).observe(canvas.parentNode);
  }
  for (const toggle of document.querySelectorAll("button[data-variant]")) {
    toggle.addEventListener("click", () => {
      const shown = toggle.getAttribute("aria-pressed") !== "true";
      toggle.setAttribute("aria-pressed", String(shown));
      if (shown) hidden.delete(toggle.dataset.variant); else hidden.add(toggle.dataset.variant);
      document.getElementById("views").classList.toggle("no-variant-" + toggle.dataset.variant, !shown);
      redraw();
    });
  }
  document.getElementById("theme").addEventListener("click", redraw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
})();
