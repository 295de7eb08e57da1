"use strict";
// What happened when: events of the cell as buttons and as marks of the scrubber, and the changed outcomes of the whole run.

const SHAPES = { collision: "round", offroad: "square", plans: "diamond", frame: "tick" };

class Moments {
  constructor(index, { list, marks, flips, flipsTitle, left }, onJump, onCell) {
    Object.assign(this, { index, list, marks, flips, flipsTitle, left, onJump, onCell, all: [] });
  }

  load(cell, from, to) {
    const own = cell.drives.flatMap((drive, i) => (drive.moments ?? []).map((one) => ({ ...one, i, renderer: drive.renderer, why: one.kind === "frame" ? "" : drive.why })));
    const parts = cell.parts.map((one) => ({ ...one, i: cell.drives.findIndex((drive) => drive.renderer === one.renderer) }));
    this.all = [...own, ...parts].filter((one) => one.t !== null).sort((a, b) => a.t - b.t);
    const untimed = own.filter((one) => one.t === null);
    this.list.replaceChildren(...this.all.map((one) => this.row(one)), ...untimed.map((one) => this.untimed(one)));
    if (!this.list.children.length) this.list.append(make("li", "small muted none", "No collision, no departure from the road, no replaced frame."));
    this.marks.replaceChildren(...this.all.map((one) => {
      const mark = make("i", `sign ${SHAPES[one.kind] ?? "tick"} ${variantClass(this.index, one.renderer)}`);
      mark.style.left = `${((one.t - from) / (to - from)) * 100}%`;
      return mark;
    }));
  }

  row(moment) {
    const item = make("li"), button = make("button", variantClass(this.index, moment.renderer));
    button.type = "button";
    button.append(make("span", "time num", `${seconds(moment.t)} s`), make("i", `sign ${SHAPES[moment.kind] ?? "tick"}`));
    const said = make("span", "said");
    said.append(make("b", "name", moment.renderer), " " + moment.text);
    button.append(said);
    button.addEventListener("click", () => this.onJump(moment));
    item.append(button);
    if (moment.why && this.index.report) item.append(Object.assign(make("a", "why-link small", "why"), { href: this.index.report.replace(/report\.html$/, "") + moment.why }));
    moment.button = button;
    return item;
  }

  untimed(moment) {
    return make("li", "small muted none", `${moment.renderer}: ${moment.text} at a time that no step shows`);
  }

  // The next event after t, or the one before.
  beside(t, forward) {
    return forward ? this.all.find((one) => one.t > t + 1) : this.all.findLast((one) => one.t < t - 1);
  }

  show(t) {
    const now = this.all.findLast((one) => one.t <= t + 1);
    if (now === this.now) return;
    this.now?.button?.removeAttribute("aria-current");
    now?.button?.setAttribute("aria-current", "true");
    this.now = now;
  }

  // Cells of the run that end differently behind two renderers.
  loadFlips(cells) {
    const rows = cells.flatMap((cell) => cell.flips.map((flip) => ({ cell, flip })));
    this.flipsTitle.textContent = rows.length ? `Changed outcomes (${rows.length})` : "Changed outcomes";
    this.flips.replaceChildren(...rows.map(({ cell, flip }) => {
      const item = make("li"), button = make("button", `flip ${flip.tone} ${variantClass(this.index, flip.renderer)}`);
      button.type = "button";
      button.disabled = !cell.here;
      button.dataset.cell = cell.id;
      const what = make("span", "said");
      what.append(make("b", "name", `${cell.scene}, seed ${cell.seed}`), make("span", "small", `${flip.was} → ${flip.now}`));
      button.append(make("span", "swatch"), what);
      button.title = `${flip.renderer} against ${this.index.baseline}` + (cell.here ? "" : ": not in this page");
      button.addEventListener("click", () => this.onCell(cell.id, flip.renderer));
      item.append(button);
      return item;
    }));
    const none = this.index.renderers.length > 1 ? "None: every pair of rollouts ends alike." : "Nothing to compare: the run has one renderer and one policy.";
    if (!rows.length) this.flips.append(make("li", "small muted none", none));
  }

  markCell(id) {
    for (const button of this.flips.querySelectorAll("button")) {
      if (button.dataset.cell === id) button.setAttribute("aria-current", "true"); else button.removeAttribute("aria-current");
    }
  }

  loadNotes(notes) {
    this.left.replaceChildren(...notes.map((note) => make("p", "small muted name", note)));
    this.left.hidden = !notes.length;
  }
}
