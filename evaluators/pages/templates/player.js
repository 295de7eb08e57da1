"use strict";
// The page: which cell is shown, the clock, and the controls. Everything that depends on time is set by `seek`.

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const LAYERS = [["plan", ["plan"]], ["plan and map", ["plan", "samples", "lanes", "recorded", "users"]], ["where it comes from (blue: recorded, orange: made up)", ["trust"]], ["nothing", []]];

const player = {
  index: JSON.parse(byId("index").textContent),
  cell: null, t: 0, from: 0, to: 1, step: 100, playing: false, speed: 1, focus: 0, hidden: new Set(), camera: "",
  drawn: Promise.resolve(),

  start() {
    const { index } = this;
    this.cameras = new Cameras(byId("cameras"), index, (i) => this.setFocus(i), (i) => this.toggle(i));
    this.birdseye = new Birdseye(byId("birdseye"), index);
    this.birdseye.onView = () => this.showView();
    this.curves = new Curves(byId("curves"), byId("chooser"), index, (t) => this.seek(t));
    const places = { list: byId("moments"), marks: byId("marks"), flips: byId("flips"), flipsTitle: byId("flips-title"), left: byId("left-out") };
    this.moments = new Moments(index, places, (moment) => this.jump(moment), (id, renderer) => this.open(id, { renderer }));
    this.bind();
    this.showIndex();
    window.addEventListener("hashchange", () => this.openFromAddress());
    if (!this.openFromAddress() && this.here().length) this.open(this.here()[0].id);
  },

  // Cells.
  here() { return this.index.cells.filter((cell) => cell.here); },
  entry(id) { return this.index.cells.find((cell) => cell.id === id); },

  showIndex() {
    this.moments.loadFlips(this.index.cells);
    this.moments.loadNotes(this.index.notes);
    this.fillPickers();
    byId("report").hidden = !this.index.report;
    byId("report").href = this.index.report;
    byId("empty").hidden = this.here().length > 0;
    byId("empty").textContent = "No rollout of this run ran to its end, so there is nothing to watch.";
    byId("main").hidden = !this.here().length;
  },

  fillPickers() {
    const { cells } = this.index, now = this.entry(this.cell?.id) ?? this.here()[0] ?? cells[0];
    const fill = (select, values, value, label = String) => {
      select.replaceChildren(...values.map((one) => {
        const option = make("option", "", label(one));
        option.value = String(one);
        option.disabled = !cells.some((cell) => cell.here && String(cell[select.name]) === String(one));
        option.selected = String(one) === String(value);
        return option;
      }));
      select.disabled = values.length < 2;
    };
    const unique = (key) => [...new Set(cells.map((cell) => cell[key]))];
    fill(byId("scene"), unique("scene"), now?.scene);
    fill(byId("policy"), unique("policy"), now?.policy);
    fill(byId("seed"), unique("seed").sort((a, b) => a - b), now?.seed, (seed) => "seed " + seed);
  },

  // The cell with the picked value that otherwise differs least from the one shown.
  pick(key, value) {
    const now = this.entry(this.cell?.id), keys = ["scene", "policy", "seed"];
    const alike = (cell) => keys.filter((one) => now && cell[one] === now[one]).length;
    const fitting = this.here().filter((cell) => String(cell[key]) === value).sort((a, b) => alike(b) - alike(a));
    if (fitting.length) this.open(fitting[0].id); else this.fillPickers();
  },

  async open(id, { renderer = null, t = null } = {}) {
    this.opening = id;
    const stored = byId("cell-" + id);
    const cell = stored ? JSON.parse(stored.textContent) : null;
    if (!cell || this.opening !== id) return;
    const { index } = this, entry = this.entry(id), driven = cell.drives.filter((drive) => drive.ego);
    const changed = renderer ?? entry.flips[0]?.renderer ?? driven[0]?.renderer;
    const focus = cell.drives.findIndex((drive) => drive.renderer === changed && drive.ego);
    const times = driven.flatMap((drive) => [drive.ego.t[0], ...(drive.cameras ?? []).slice(0, 1).map((one) => one.t[0])]);
    const imaged = driven.some((drive) => drive.cameras?.length); // before the first frame there is nothing to see
    Object.assign(this, { cell, from: imaged ? Math.min(...driven.flatMap((drive) => (drive.cameras ?? []).map((one) => one.t[0]))) : Math.min(0, ...times), to: cell.end, hidden: new Set(), focus: Math.max(0, focus) });
    this.step = Math.max(10, Math.round((driven[0]?.ego.t.at(-1) - driven[0]?.ego.t.at(-2)) || 100));
    document.title = `${entry.scene} – ${index.run} – simrun view`;
    this.birdseye.load(cell);
    this.curves.load(cell, this.from, this.to);
    this.moments.load(cell, this.from, this.to);
    this.moments.markCell(id);
    this.fillPickers();
    this.fillCameraPicker();
    this.cameras.load(cell, entry.outcomes, this.camera);
    this.cameras.mark(this.focus, this.hidden);
    this.showView();
    const range = byId("scrub");
    Object.assign(range, { min: this.from, max: this.to, step: 10 });
    byId("total").textContent = seconds(this.to);
    this.legend();
    const parts = cell.parts.find((one) => one.renderer === changed) ?? this.moments.all[0];
    this.seek(t ?? (parts ? parts.t - 1000 : 0));
    this.say(`${entry.scene}, ${entry.policy}, seed ${entry.seed}`);
  },

  fillCameraPicker() {
    const names = [...new Set(this.cell.drives.flatMap((drive) => (drive.cameras ?? []).map((one) => one.name)))];
    byId("camera-label").hidden = names.length < 2;
    if (!names.includes(this.camera)) this.camera = names[0] ?? "";
    byId("camera").replaceChildren(...names.map((name) => Object.assign(make("option", "", name), { value: name, selected: name === this.camera })));
  },

  legend() {
    const drive = this.cell.drives[this.focus], kinds = new Set((drive?.users ?? []).map((i) => this.cell.users[i].label));
    const shapes = { disc: [], "box strong": [], box: [] };
    for (const kind of [...kinds].sort()) shapes[kindOf(kind) === "pedestrian" ? "disc" : onFoot(kind) ? "box strong" : "box"].push(kind);
    byId("kinds").replaceChildren(...Object.entries(shapes).filter(([, named]) => named.length).map(([shape, named]) => {
      const item = make("span", "item");
      item.append(make("i", `kind ${shape}${shape === "disc" ? " strong" : ""}`), named.join(", "));
      return item;
    }));
    byId("outlines").hidden = !this.cell.drives.some((one, i) => i !== this.focus && one.users?.some((user) => !drive?.users?.includes(user)));
  },

  // The clock.
  seek(t) {
    this.t = Math.min(this.to, Math.max(this.from, t));
    this.show();
  },

  show() {
    const { t } = this;
    this.birdseye.draw(t, this.focus, this.hidden);
    this.drawn = this.cameras.show(t);
    this.curves.show(t);
    this.moments.show(t);
    const range = byId("scrub"), text = seconds(t);
    range.value = String(t);
    range.style.setProperty("--done", `${(((t - this.from) / (this.to - this.from)) * 100).toFixed(2)}%`);
    if (this.saidTime !== text) {
      this.saidTime = text;
      byId("time").textContent = text;
      range.setAttribute("aria-valuetext", `${text} of ${seconds(this.to)} seconds`);
    }
  },

  play(on) {
    if (on === this.playing) return;
    this.playing = on;
    byId("play").setAttribute("aria-label", on ? "Pause" : "Play");
    byId("play").classList.toggle("on", on);
    if (!on) { this.remember(); return; }
    if (this.t >= this.to) this.seek(this.from);
    let before = null;
    const tick = (now) => {
      if (!this.playing) return;
      if (before !== null) this.seek(this.t + (now - before) * this.speed);
      before = now;
      if (this.t >= this.to) this.play(false); else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  },

  nudge(ms) { this.play(false); this.seek(this.t + ms); this.remember(); },
  setSpeed(speed) { this.speed = speed; byId("speed").value = String(speed); },

  jump(moment) {
    this.play(false);
    if (moment.i >= 0) this.setFocus(moment.i);
    this.seek(moment.t);
    this.remember();
    this.say(`${seconds(moment.t)} seconds, ${moment.renderer}, ${moment.text}`);
  },

  beside(forward) {
    const moment = this.moments.beside(this.t, forward);
    if (moment) this.jump(moment); else this.say(forward ? "No later event" : "No earlier event");
  },

  neighbour(by) {
    const here = this.here(), i = here.findIndex((cell) => cell.id === this.cell?.id);
    if (here[i + by]) this.open(here[i + by].id); else this.say(by > 0 ? "The last one" : "The first one");
  },

  // What is seen.
  setFocus(i) {
    if (!this.cell.drives[i]?.ego) return;
    this.focus = i;
    this.hidden.delete(i);
    this.refresh();
  },

  toggle(i) {
    if (this.hidden.has(i)) this.hidden.delete(i); else this.hidden.add(i);
    this.refresh();
  },

  refresh() {
    this.cameras.mark(this.focus, this.hidden);
    this.curves.mark(this.hidden);
    this.legend();
    this.show();
  },

  showView() {
    for (const [id, on] of [["follow", this.birdseye.follow], ["whole", !this.birdseye.follow]]) byId(id).setAttribute("aria-pressed", String(on));
    if (this.cell) this.birdseye.draw(this.t, this.focus, this.hidden);
  },

  // What is drawn over the images: the plan, all that is known, nothing.
  nextLayers() {
    const there = LAYERS.filter(([, [first]]) => first !== "trust" || this.cameras.hasTrust());
    const [name, layers] = there[(there.findIndex(([name]) => name === byId("over").dataset.name) + 1) % there.length];
    Object.assign(byId("over"), { textContent: `Over the image: ${name}` }).dataset.name = name;
    this.cameras.setLayers(layers);
    if (this.cell) this.show();
  },

  say(text) { byId("said").textContent = text; },

  // The address names what is shown, so that it can be sent to somebody.
  remember() {
    const entry = this.entry(this.cell?.id);
    if (!entry) return;
    const words = new URLSearchParams({ scene: entry.scene, policy: entry.policy, seed: entry.seed, t: seconds(this.t, 2).replace(MINUS, "-") });
    if (entry.take) words.set("take", entry.take);
    try { history.replaceState(null, "", "#" + words); } catch { /* a page from disk may not be allowed to */ }
  },

  openFromAddress() {
    const words = new URLSearchParams(location.hash.slice(1));
    if (!words.has("scene")) return false;
    const fits = (cell) => ["scene", "policy", "seed", "take"].every((key) => !words.has(key) || words.get(key) === String(cell[key]));
    const cell = this.index.cells.find(fits);
    if (!cell?.here) { this.say("That rollout is not in this page."); byId("missing").hidden = false; return false; }
    this.open(cell.id, { renderer: words.get("renderer"), t: words.has("t") ? Number(words.get("t")) * 1000 : null });
    return true;
  },

  bind() {
    const click = (id, act) => byId(id).addEventListener("click", act);
    click("play", () => this.play(!this.playing));
    click("back", () => this.nudge(-this.step));
    click("forward", () => this.nudge(this.step));
    click("event-before", () => this.beside(false));
    click("event-after", () => this.beside(true));
    click("cell-before", () => this.neighbour(-1));
    click("cell-after", () => this.neighbour(1));
    click("follow", () => this.birdseye.setFollow(true));
    click("whole", () => this.birdseye.setFollow(false));
    click("nearer", () => this.birdseye.zoomBy(1.4));
    click("farther", () => this.birdseye.zoomBy(1 / 1.4));
    click("over", () => this.nextLayers());
    click("help", () => byId("keys").showModal());
    click("close-help", () => byId("keys").close());
    byId("scrub").addEventListener("input", (event) => { this.play(false); this.seek(Number(event.target.value)); });
    byId("scrub").addEventListener("change", () => this.remember());
    byId("speed").replaceChildren(...SPEEDS.map((speed) => {
      const option = make("option", "", speed + "\u00d7");
      return Object.assign(option, { value: String(speed), selected: speed === 1 });
    }));
    byId("speed").addEventListener("change", (event) => this.setSpeed(Number(event.target.value)));
    for (const key of ["scene", "policy", "seed"]) byId(key).addEventListener("change", (event) => this.pick(key, event.target.value));
    byId("camera").addEventListener("change", (event) => {
      this.camera = event.target.value;
      this.cameras.load(this.cell, this.entry(this.cell.id).outcomes, this.camera);
      this.refresh();
    });
    document.addEventListener("keydown", (event) => this.key(event));
    const redraw = () => { this.birdseye.readColours(); if (this.cell) this.show(); };
    new ResizeObserver(redraw).observe(byId("birdseye"));
    byId("theme").addEventListener("click", redraw);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  },

  key(event) {
    const { key } = event;
    if (event.ctrlKey || event.metaKey || event.altKey || byId("keys").open || !this.cell) return;
    const { target } = event, onButton = target.matches?.("button, summary, a, input[type=checkbox]"), choosing = target.matches?.("select");
    if (choosing || (onButton && (key === " " || key === "Enter"))) return; // the control's own keys
    const speed = SPEEDS.indexOf(this.speed), long = event.shiftKey ? 1000 : this.step;
    const acts = {
      " ": () => this.play(!this.playing), k: () => this.play(!this.playing),
      ArrowLeft: () => this.nudge(-long), ArrowRight: () => this.nudge(long),
      Home: () => this.nudge(this.from - this.to), End: () => this.nudge(this.to - this.from),
      e: () => this.beside(true), E: () => this.beside(false),
      "[": () => this.neighbour(-1), "]": () => this.neighbour(1),
      ",": () => this.setSpeed(SPEEDS[Math.max(0, speed - 1)]), ".": () => this.setSpeed(SPEEDS[Math.min(SPEEDS.length - 1, speed + 1)]),
      "+": () => this.birdseye.zoomBy(1.4), "-": () => this.birdseye.zoomBy(1 / 1.4),
      o: () => this.nextLayers(),
      f: () => this.birdseye.setFollow(!this.birdseye.follow),
      "?": () => byId("keys").showModal(),
    };
    const act = acts[key] ?? (/^[1-9]$/.test(key) ? () => this.setFocus(Number(key) - 1) : null);
    if (!act) return;
    event.preventDefault();
    act();
  },
};

player.start();
