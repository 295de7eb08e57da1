// All arms of one clip on one clock: a slider, a player, a wipe against one arm, and the curves of every metric below.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const get = (id) => document.getElementById(id);
  const arms = [...document.querySelectorAll(".arm")];
  const slider = get("frame"), at = get("at"), play = get("play"), against = get("against"), wipe = get("wipe");
  const hidden = new Set();
  let clip = null, images = [], timer = 0;

  const decode = (film) => film.map((jpeg) => {
    const image = new Image();
    image.src = "data:image/jpeg;base64," + jpeg;
    return image;
  });

  const draw = () => {
    const frame = Number(slider.value), other = against.value === "" ? null : Number(against.value);
    arms.forEach((figure, k) => {
      if (hidden.has(k)) return;
      const canvas = figure.querySelector("canvas"), pen = canvas.getContext("2d"), image = images[k] && images[k][frame];
      const paint = (source, from, to) => {
        if (!source) return;
        if (!source.complete) { source.addEventListener("load", draw, { once: true }); return; }
        pen.save(); pen.beginPath(); pen.rect(from, 0, to - from, canvas.height); pen.clip();
        pen.drawImage(source, 0, 0, canvas.width, canvas.height); pen.restore();
      };
      const edge = other === null || other === k ? canvas.width : Math.round(canvas.width * Number(wipe.value) / 100);
      paint(image, 0, edge);
      if (edge < canvas.width) {
        paint(images[other][frame], edge, canvas.width);
        pen.fillStyle = "#fff"; pen.fillRect(edge - 1, 0, 2, canvas.height);
      }
      const series = clip.curves[0] && clip.curves[0].lines[k];
      figure.querySelector(".number").textContent = series && series[frame] != null ? series[frame].toFixed(clip.curves[0].digits) + " " + clip.curves[0].unit : "";
    });
    get("all").textContent = hidden.size ? "Show all" : "Hide all";
    at.textContent = frame + " of " + (clip.frames - 1);
    document.querySelectorAll(".charts .at").forEach((line) => {
      const x = Number(line.dataset.left) + frame * Number(line.dataset.step);
      line.setAttribute("x1", x); line.setAttribute("x2", x);
    });
  };

  const SVG = "http://www.w3.org/2000/svg";
  const node = (name, attributes, text) => {
    const made = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  };
  const DASHES = ["none", "5 3", "1 2", "8 2 1 2"];  // with eight colours, 32 arms are told apart
  const W = 420, H = 190, L = 46, R = 8, T = 8, B = 22;
  const charts = () => {
    get("charts").replaceChildren(...clip.curves.map((curve) => {
      const shown = curve.lines.map((line, k) => (hidden.has(k) || !line ? [] : line));
      const values = shown.flat().filter((v) => v !== null && Number.isFinite(v));
      const low = Math.min(...values), high = Math.max(...values), span = high - low || 1, step = (W - L - R) / Math.max(clip.frames - 1, 1);
      const x = (i) => L + i * step, y = (v) => T + (high - v) / span * (H - T - B);
      const svg = node("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": curve.title + " by frame" });
      for (const v of values.length ? [low, (low + high) / 2, high] : []) {
        svg.append(node("line", { class: "axis", x1: L, x2: W - R, y1: y(v), y2: y(v) }), node("text", { x: L - 5, y: y(v) + 3, "text-anchor": "end" }, v.toFixed(curve.digits)));
      }
      svg.append(node("text", { x: L, y: H - 6 }, "0"), node("text", { x: W - R, y: H - 6, "text-anchor": "end" }, "frame " + (clip.frames - 1)));
      shown.forEach((line, k) => {
        let path = "", pen = "M";
        line.forEach((v, i) => { if (v === null) { pen = "M"; return; } path += pen + x(i).toFixed(1) + " " + y(v).toFixed(1); pen = "L"; });
        if (!path) return;
        const made = node("path", { d: path, "data-arm": k, stroke: `var(--variant-${k % 8})`, "stroke-dasharray": DASHES[Math.floor(k / 8) % DASHES.length] });
        made.append(node("title", {}, arms[k].querySelector(".toggle").textContent));
        svg.append(made);
      });
      svg.append(node("line", { class: "at", y1: T, y2: H - B, "data-left": L, "data-step": step }));
      svg.addEventListener("click", (event) => {
        const box = svg.getBoundingClientRect();
        go(Math.round(((event.clientX - box.left) / box.width * W - L) / step));
      });
      const figure = document.createElement("figure"), caption = document.createElement("figcaption");
      figure.className = "card"; caption.textContent = curve.title; figure.append(caption, svg);
      return figure;
    }));
  };

  const point = (k) => {  // one arm's curves before all others; null: none
    get("charts").querySelectorAll("svg").forEach((svg) => svg.classList.toggle("pointed", k !== null && svg.querySelector(`path[data-arm="${k}"]`) !== null));
    get("charts").querySelectorAll("path").forEach((path) => path.classList.toggle("of", Number(path.dataset.arm) === k && k !== null));
  };
  const show = (k, shown) => {
    shown ? hidden.delete(k) : hidden.add(k);
    arms[k].classList.toggle("off", !shown);
    arms[k].querySelector(".toggle").setAttribute("aria-pressed", String(shown));
  };

  const go = (frame) => { slider.value = Math.max(0, Math.min(clip.frames - 1, frame)); draw(); };
  const stop = () => { clearInterval(timer); timer = 0; play.textContent = "Play"; play.setAttribute("aria-pressed", "false"); };
  const start = () => {
    timer = setInterval(() => go((Number(slider.value) + 1) % clip.frames), 1000 / Number(get("rate").value));
    play.textContent = "Pause"; play.setAttribute("aria-pressed", "true");
  };
  const choose = (k) => {
    clip = data.clips[k];
    images = clip.films.map(decode);
    slider.max = clip.frames - 1;
    document.querySelectorAll("[data-clip]").forEach((b) => b.setAttribute("aria-pressed", String(Number(b.dataset.clip) === k)));
    charts(); go(Math.min(Number(slider.value), clip.frames - 1));
  };

  slider.addEventListener("input", draw);
  wipe.addEventListener("input", draw);
  against.addEventListener("change", () => { wipe.disabled = against.value === ""; draw(); });
  play.addEventListener("click", () => (timer ? stop() : start()));
  get("rate").addEventListener("change", () => { if (timer) { stop(); start(); } });
  document.querySelectorAll("[data-clip]").forEach((b) => b.addEventListener("click", () => choose(Number(b.dataset.clip))));
  arms.forEach((figure, k) => {
    figure.querySelector(".toggle").addEventListener("click", () => { show(k, hidden.has(k)); charts(); draw(); });
    figure.addEventListener("pointerenter", () => point(k));
    figure.addEventListener("pointerleave", () => point(null));
    figure.addEventListener("focusin", () => point(k));
    figure.addEventListener("focusout", () => point(null));
  });
  get("all").addEventListener("click", () => { const shown = hidden.size > 0; arms.forEach((_, k) => show(k, shown)); charts(); draw(); });
  document.addEventListener("keydown", (event) => {
    if (event.target.matches("select, input[type=range]") && event.key !== " ") return;
    const moves = { ArrowLeft: -1, ArrowRight: 1 };
    if (event.key === " " && !event.target.matches("button")) { timer ? stop() : start(); event.preventDefault(); }
    else if (event.key in moves) { go(Number(slider.value) + moves[event.key]); event.preventDefault(); }
    else if (event.key === "Home") go(0);
    else if (event.key === "End") go(clip.frames - 1);
  });
  choose(0);
})();
