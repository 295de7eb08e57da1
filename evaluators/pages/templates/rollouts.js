// The table of every rollout: columns are unpacked once, rows are drawn where they are looked at.
(() => {
  const holder = document.getElementById("rollouts-data");
  if (!holder) return;
  const ROW = 34, SPARE = 8; // height of a row in pixels, as in the style sheet; rows drawn beyond the edges
  const HAS_FOLDER = 1, HAS_CLIP = 2, HAS_WHY = 4;
  const at = (id) => document.getElementById(id);
  const box = at("rollouts-box"), table = at("table-rollouts"), head = table.tHead.rows[0], body = table.tBodies[0], picked = at("rollouts-picked");
  const make = (tag, text, more = {}) => Object.assign(document.createElement(tag), text === undefined ? {} : { textContent: text }, more);

  const unpack = async () => {
    const packed = Uint8Array.from(atob(holder.content.textContent), (letter) => letter.charCodeAt(0));
    holder.remove();
    return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).json();
  };

  const start = ({ coloured: [colouredBy, coloured], kinds, endings, texts, had, state, numbers }) => {
    const rows = state.length, text = (name, row) => texts[name][row];
    const shortly = new Intl.NumberFormat("en", { minimumSignificantDigits: 4, maximumSignificantDigits: 4, useGrouping: false });
    const number = (one, row) => {
      const value = one.data[row];
      if (value === null) return "\u2014";
      if (one.flag && (value === 0 || value === 1)) return value ? "yes" : "no";
      if (value === 0) return one.percent ? "0\u00a0%" : one.unit ? "0\u00a0" + one.unit : "0";
      return (shortly.format(one.percent ? 100 * value : value) + (one.percent ? "\u00a0%" : one.unit ? "\u00a0" + one.unit : "")).replace("-", "\u2212");
    };
    const quoted = (word) => /^[\w./@+-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`; // for a shell
    const outcome = (row) => text("outcome", row);
    const tone = (row) => text("tone", row);
    // The gravest outcome has the lowest bit; what could not be run comes after every outcome.
    const gravity = (row) => had[row] ? kinds.length - Math.log2(had[row] & -had[row]) : tone(row) ? 0.5 : 0;

    // What a choice of the filter keeps, by its value: everything; an event; one outcome; one ending.
    const keeps = new Map([["", () => true], ["event", (row) => had[row] !== 0]]);
    kinds.forEach(([name], bit) => keeps.set("had " + name, (row) => (had[row] >> bit) & 1));
    endings.forEach((name) => keeps.set("ended " + name, (row) => text("ending", row) === name));
    const choice = at("rollouts-state");
    const offer = (holder, value, words) => {
      const n = texts.scene.reduce((sum, _, row) => sum + (keeps.get(value)(row) ? 1 : 0), 0);
      holder.append(make("option", `${words} (${n})`, { value }));
    };
    offer(choice, "", "all");
    if (kinds.length) {
      const group = make("optgroup", undefined, { label: "had, alone or among others" });
      offer(group, "event", "any event");
      for (const [name, words] of kinds) offer(group, "had " + name, words);
      choice.append(group);
    }
    const group = make("optgroup", undefined, { label: "ended, each rollout once" });
    for (const name of endings) offer(group, "ended " + name, name);
    choice.append(group);

    // Which columns are drawn: names, the outcome, the headline numbers that are no flags, and one more of choice.
    const more = at("rollouts-more");
    const own = numbers.filter((one) => one.headline && !one.flag);
    for (const one of numbers.filter((other) => !own.includes(other))) more.append(make("option", one.name, { value: one.name }));
    const drawn = () => [
      { name: "scene", names: true }, { name: "renderer", names: true },
      ...(new Set(texts.policy).size > 1 ? [{ name: "policy", names: true }] : []),
      { name: "seed", names: true }, { name: "outcome" }, ...own, ...numbers.filter((one) => one.name === more.value),
    ];

    let order = Uint32Array.from({ length: rows }, (_, row) => row), sorted = { name: "", up: true }, opened = -1, shown = drawn(), only = null;
    const ranks = (name) => { // texts by the alphabet with numbers in it
      const { compare } = new Intl.Collator("en", { numeric: true });
      return new Map([...new Set(texts[name])].sort(compare).map((value, place) => [value, place]));
    };
    const keyOf = (one) => {
      if (one.name === "outcome") return gravity;
      if (!one.names) return (row) => one.data[row] ?? NaN;
      const rank = ranks(one.name);
      return (row) => rank.get(text(one.name, row));
    };

    const select = () => {
      const keep = keeps.get(choice.value), isOnly = (row) => !only || (text("renderer", row) === only.renderer && text("policy", row) === only.policy);
      const words = at("rollouts-words").value.toLowerCase().split(/\s+/).filter(Boolean);
      const has = (row, word) => text("seed", row) === word || ["scene", "renderer", "policy"].some((name) => text(name, row).toLowerCase().includes(word));
      const kept = new Uint32Array(rows);
      let n = 0;
      for (let row = 0; row < rows; row++) {
        if (keep(row) && isOnly(row) && words.every((word) => has(row, word))) kept[n++] = row;
      }
      order = kept.slice(0, n);
      const chosen = shown.find((one) => one.name === sorted.name);
      if (chosen) {
        const key = keyOf(chosen), keys = new Float64Array(rows), turn = sorted.up ? 1 : -1;
        for (const row of order) keys[row] = key(row);
        order.sort((a, b) => { // missing numbers stay last; equals stay in the order of the run
          const missingA = Number.isNaN(keys[a]), missingB = Number.isNaN(keys[b]);
          return missingA || missingB ? missingA - missingB || a - b : turn * (keys[a] - keys[b]) || a - b;
        });
      }
      at("rollouts-count").textContent = n === rows ? `${n} rollouts` : `${n} of ${rows} rollouts`;
      box.scrollTop = 0;
      draw();
    };

    const heads = () => {
      head.replaceChildren(...shown.map((one) => {
        const cell = make("th", undefined, { scope: "col", className: one.names || one.name === "outcome" ? "" : "r" });
        if (one.name === sorted.name) cell.setAttribute("aria-sort", sorted.up ? "ascending" : "descending");
        const button = make("button", one.name, { type: "button", className: "sort" });
        button.addEventListener("click", () => {
          sorted = { name: one.name, up: sorted.name === one.name ? !sorted.up : true };
          heads();
          select();
        });
        cell.append(button);
        return cell;
      }));
    };

    const line = (row) => {
      const tr = make("tr", undefined, { className: row === opened ? "opened" : "" });
      tr.dataset.row = row;
      for (const one of shown) {
        const td = make(one.name === "scene" ? "th" : "td", undefined, { className: one.names || one.name === "outcome" ? "name" : "r nowrap" });
        if (one.name === "scene") td.scope = "row";
        if (one.name === colouredBy && coloured.includes(text(colouredBy, row))) {
          td.append(make("span", "", { className: "swatch" }));
          td.firstChild.style.setProperty("--c", `var(--variant-${coloured.indexOf(text(colouredBy, row)) % 8})`);
        }
        if (one.name === "seed") {
          const open = make("button", text("seed", row), { type: "button", className: "open", title: "Numbers and files of this rollout" });
          td.append(open);
        } else if (one.name === "outcome") td.append(tone(row) ? make("span", outcome(row), { className: `chip ${tone(row)}` }) : outcome(row));
        else td.append(one.names ? text(one.name, row) : number(one, row));
        tr.append(td);
      }
      return tr;
    };
    const space = (n) => {
      const tr = make("tr", undefined, { className: "space" });
      tr.setAttribute("aria-hidden", "true");
      const td = make("td", undefined, { colSpan: shown.length });
      td.style.height = `${n * ROW}px`;
      tr.append(td);
      return tr;
    };
    const draw = () => {
      const first = Math.max(0, Math.floor(box.scrollTop / ROW) - SPARE), last = Math.min(order.length, first + Math.ceil(box.clientHeight / ROW) + 2 * SPARE);
      table.setAttribute("aria-rowcount", order.length + 1);
      body.replaceChildren(space(first), ...Array.from(order.subarray(first, last), line), space(order.length - last));
    };

    const open = (row) => {
      opened = row;
      const links = make("p", undefined, { className: "small" });
      const folder = text("folder", row);
      if (state[row] & HAS_WHY) links.append(make("a", "why", { href: `${folder}/why.html` }), " ");
      if (state[row] & HAS_FOLDER) links.append(make("a", "rollout folder", { href: `${folder}/` }), " ");
      if (state[row] & HAS_CLIP) links.append(make("a", "clip", { href: `${folder}/front.mp4` }), " ");
      if (!(state[row] & HAS_FOLDER)) links.append("No folder of this rollout is beside this page. ");
      links.append("Watch it: ", make("code", `simrun view RUN --scene ${quoted(text("scene", row))} --seed ${text("seed", row)}`));
      const facts = make("dl");
      for (const one of numbers) facts.append(make("dt", one.name), make("dd", number(one, row)));
      const title = make("h3", `${text("scene", row)}, ${text("renderer", row)}, ${text("policy", row)}, seed ${text("seed", row)}: ${outcome(row)}`);
      const note = text("note", row);
      picked.replaceChildren(title, ...(note ? [make("p", note, { className: "message" })] : []), links, facts);
      picked.hidden = false;
      draw();
    };

    // A segment of the first screen shows its rollouts: one variant's, with one ending.
    const onlyButton = at("rollouts-only");
    const restrict = (variant) => {
      only = variant;
      onlyButton.hidden = !only;
      if (only) onlyButton.textContent = `${only.renderer}, ${only.policy} \u00d7`;
    };
    onlyButton.addEventListener("click", () => { restrict(null); select(); });
    document.addEventListener("click", (event) => {
      const link = event.target.closest("a[data-ended]");
      if (!link) return;
      restrict({ renderer: link.dataset.renderer, policy: link.dataset.policy });
      at("rollouts-words").value = "";
      choice.value = "ended " + link.dataset.ended;
      select();
    });

    let waiting = false;
    box.addEventListener("scroll", () => {
      if (!waiting) requestAnimationFrame(() => { waiting = false; draw(); });
      waiting = true;
    });
    body.addEventListener("click", (event) => {
      const tr = event.target.closest("tr[data-row]");
      if (tr) open(Number(tr.dataset.row));
    });
    more.addEventListener("change", () => { shown = drawn(); heads(); select(); });
    at("rollouts-words").addEventListener("input", select);
    choice.addEventListener("change", select);
    new ResizeObserver(draw).observe(box);
    heads();
    select();
    box.dataset.ready = "yes";
  };

  unpack().then(start).catch((error) => {
    at("rollouts-count").textContent = `This browser cannot unpack the table (${error.message}); rollouts.parquet holds the same rows.`;
  });
})();
