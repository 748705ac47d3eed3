// The map: a quantity over two axes, the others at chosen values or at any; and its colours.
const CIVIDIS = ["#00204d", "#00336f", "#39486b", "#575c6d", "#707173", "#8a8779", "#a69d75", "#c4b56c", "#e4cf5b", "#ffea46"]
  .map((color) => [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16)));
const KINDS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#7f7f7f", "#5b4fa0", "#8c564b", "#17becf", "#b5cf6b"];

function cividis(share) {
  const at = Math.max(0, Math.min(1, share)) * (CIVIDIS.length - 1), i = Math.min(CIVIDIS.length - 2, Math.floor(at));
  return CIVIDIS[i].map((part, c) => Math.round(part + (CIVIDIS[i + 1][c] - part) * (at - i)));
}
const rgb = (parts) => `rgb(${parts.join()})`;
const isLight = (parts) => 0.299 * parts[0] + 0.587 * parts[1] + 0.114 * parts[2] > 140;
const partsOf = (color) => [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16));

const maps = {
  answer: null, cursor: null, place: null, fixed: {}, asked: 0,

  init(about) {
    const options = (names) => Object.entries(names).map(([value, label]) => h("option", { value }, label));
    const axes = Object.fromEntries(about.axes.map(({ name }) => [name, name]));
    fill("map-what", options(about.quantities));
    fill("map-x", options(axes)); fill("map-y", options(axes));
    [$("map-x").value, $("map-y").value] = about.first;
    for (const id of ["map-x", "map-y"]) $(id).disabled = about.variables.length < 2;
    for (const id of ["map-what", "map-how"]) $(id).addEventListener("change", () => this.load());
    for (const id of ["map-x", "map-y"]) $(id).addEventListener("change", () => {
      const other = $(id === "map-x" ? "map-y" : "map-x");
      if (other.value === $(id).value) other.value = about.axes.map(({ name }) => name).find((name) => name !== $(id).value) || other.value;
      this.sliders(); this.load();
    });
    $("map-fix").addEventListener("click", () => { this.others().forEach(({ name }, _, all) => { this.fixed[name] = world.here.values[this.number(name)]; }); this.sliders(); this.load(); });
    $("map-free").addEventListener("click", () => { this.fixed = {}; this.sliders(); this.load(); });
    const canvas = $("map-canvas");
    canvas.addEventListener("pointermove", (event) => this.point(this.cellAt(event)));
    canvas.addEventListener("pointerleave", () => this.point(null));
    canvas.addEventListener("click", (event) => this.go(this.cellAt(event)));
    canvas.addEventListener("focus", () => { if (!canvas.matches(":focus-visible")) return; this.point(this.cursor || this.here() || [0, 0], true); });
    canvas.addEventListener("keydown", (event) => this.key(event));
    this.sliders();
    this.load();
  },

  number: (name) => world.about.variables.findIndex((each) => each.name === name),
  others() {
    const drawn = [$("map-x").value, $("map-y").value];
    return world.about.variables.length < 2 ? [] : world.about.variables.filter(({ name }) => !drawn.includes(name));
  },

  sliders() {
    const others = this.others();
    for (const name of Object.keys(this.fixed)) if (!others.some((each) => each.name === name)) delete this.fixed[name];
    $("map-others").hidden = !others.length;
    fill("map-sliders", others.map(({ name, low, size }, i) => {
      const id = `slider-${i}`, shown = h("output", { for: id });
      const range = h("input", { id, type: "range", min: low, max: low + size - 1, step: 1, value: this.fixed[name] ?? world.here.values[this.number(name)] });
      const any = h("button", { type: "button", "aria-label": `${name}: any value` }, "any");
      const said = () => {
        any.setAttribute("aria-pressed", !(name in this.fixed));
        shown.textContent = name in this.fixed ? this.fixed[name] : "any";
        range.setAttribute("aria-valuetext", shown.textContent);
        this.saidOthers();
      };
      range.addEventListener("input", () => { this.fixed[name] = Number(range.value); said(); this.later(); });
      any.addEventListener("click", () => {
        if (name in this.fixed) delete this.fixed[name]; else this.fixed[name] = Number(range.value);
        said(); this.load();
      });
      said();
      return h("div", {}, h("label", { for: id, title: name }, name), range, shown, any);
    }));
    this.saidOthers();
  },
  saidOthers() {
    const set = Object.entries(this.fixed).map(([name, value]) => `${name} = ${value}`);
    $("map-others-said").textContent = `Other variables: ${set.length ? set.join(", ") : "any value"}`;
  },

  later() { clearTimeout(this.timer); this.timer = setTimeout(() => this.load(), 90); },
  async load() {
    const asked = ++this.asked, words = { x: $("map-x").value, y: $("map-y").value, what: $("map-what").value, how: $("map-how").value };
    for (const [name, value] of Object.entries(this.fixed)) words[`fix.${name}`] = value;
    $("map-said").textContent = "...";
    const answer = await attempt(() => source.ask("map", words));
    if (asked !== this.asked || !answer) return;
    this.answer = answer;
    if (this.cursor && (this.cursor[0] >= answer.y.count || this.cursor[1] >= answer.x.count)) this.cursor = null;
    this.draw();
  },

  color(value) {
    const { what, low, high } = this.answer;
    if (what === "best_action") return value < 0 ? null : partsOf(KINDS[value % KINDS.length]);
    return cividis(high > low ? (value - low) / (high - low) : 0.5);
  },

  // Sizes: what fits into the card, cells square where they are not too flat
  draw() {
    const { answer } = this;
    if (!answer) return;
    const { x, y, cells, terminal, count: counts } = answer, canvas = $("map-canvas");
    const room = canvas.closest(".card").clientWidth - 40, left = 50, bottom = 42, top = 4, right = 8;
    const cell = Math.max(2, Math.min(58, (room - left - right) / x.count, Math.max(380 / y.count, 26)));
    const tall = Math.max(cell, Math.min(58, 120 / y.count));
    const width = left + right + cell * x.count, height = top + bottom + tall * y.count;
    const context = sized(canvas, width, height);
    const ink = style("--ink"), muted = style("--muted"), soft = style("--soft"), line = style("--line");
    this.place = { left, top, cell, tall };
    context.fillStyle = soft;
    context.fillRect(left, top, cell * x.count, tall * y.count);
    const gap = cell > 14 ? 1 : 0;
    context.textAlign = "center"; context.textBaseline = "middle";
    cells.forEach((row, i) => row.forEach((value, j) => {
      if (!counts[i][j]) return;
      const at = [left + j * cell, top + i * tall], parts = value === null ? null : this.color(value);
      context.fillStyle = parts ? rgb(parts) : line;
      context.fillRect(at[0], at[1], cell - gap, tall - gap);
      if (cell < 30) return;
      context.fillStyle = parts ? (isLight(parts) ? "#101216" : "#f4f5f7") : ink;
      const word = value === null ? (terminal[i][j] ? "end" : "") : answer.what === "best_action" ? (value < 0 ? "mixed" : sign(world.about.actions[value])) : text(value, 3);
      context.font = `${answer.what === "best_action" && value >= 0 ? Math.min(20, cell * 0.5) : Math.min(13, (1.55 * cell) / Math.max(3, word.length))}px system-ui, sans-serif`;
      context.fillText(word, at[0] + (cell - gap) / 2, at[1] + (tall - gap) / 2);
    }));
    this.axes(context, { left, top, cell, tall }, ink, muted);
    this.mark(context);
    this.legend();
    canvas.setAttribute("aria-label", `Map of ${world.about.quantities[answer.what]} over ${x.name} and ${y.name}, from ${text(answer.low)} to ${text(answer.high)}. Arrow keys move over its cells, Enter goes to a state.`);
    this.point(null);
  },
  axes(context, { left, top, cell, tall }, ink, muted) {
    const { x, y } = this.answer;
    const label = (axis, i) => String(axis.low + i * axis.width);
    const every = (n, size, need) => { let step = 1; while (step * size < need || n / step > 24) step = step < 2 ? 2 : step < 5 ? 5 : 10 * (step / 5); return step; };
    context.font = "12px system-ui, sans-serif"; context.fillStyle = muted;
    context.textAlign = "center"; context.textBaseline = "top";
    const stepX = every(x.count, cell, 9 * label(x, x.count - 1).length + 8), stepY = every(y.count, tall, 15);
    for (let j = 0; j < x.count; j += stepX) context.fillText(label(x, j), left + (j + 0.5) * cell, top + tall * y.count + 5);
    context.textAlign = "right"; context.textBaseline = "middle";
    for (let i = 0; i < y.count; i += stepY) context.fillText(label(y, i), left - 6, top + (i + 0.5) * tall);
    context.fillStyle = ink; context.textAlign = "center"; context.textBaseline = "top"; context.font = "600 12.5px system-ui, sans-serif";
    context.fillText(x.name, left + (cell * x.count) / 2, top + tall * y.count + 23);
    context.save(); context.translate(9, top + (tall * y.count) / 2); context.rotate(-Math.PI / 2); context.textBaseline = "middle";
    context.fillText(y.name, 0, 0); context.restore();
  },

  // The cell of the state that is shown
  here() {
    if (!this.answer || !world.here) return null;
    const { x, y } = this.answer;
    const at = (axis) => {
      const part = Math.floor((world.here.values[axis.variable] - axis.origin) / axis.divisor);
      return Math.floor((axis.modulus ? part % axis.modulus : part) / axis.width);
    };
    return [at(y), at(x)];
  },
  mark(context) {
    const box = ([i, j], color, width) => {
      const { left, top, cell, tall } = this.place, inset = Math.min(1, cell / 8);
      context.strokeStyle = color; context.lineWidth = width;
      context.strokeRect(left + j * cell + inset, top + i * tall + inset, Math.max(3, cell - 2 * inset - 1), Math.max(3, tall - 2 * inset - 1));
    };
    const here = this.here();
    if (here) { box(here, "#ffffff", 4); box(here, "#d9480f", 2.5); }
    if (this.cursor) { box(this.cursor, "#ffffff", 4); box(this.cursor, "#111111", 1.5); }
  },
  legend() {
    const { what, low, high, cells } = this.answer, { actions } = world.about;
    const frame = h("span", {}, swatch(style("--card"), "2px solid #d9480f"), "this state");
    if (what === "best_action") {
      const seen = new Set(cells.flat());
      fill("map-legend", actions.map((name, i) => seen.has(i) ? h("span", {}, swatch(KINDS[i % KINDS.length]), name) : null), seen.has(-1) ? h("span", {}, swatch(style("--line")), "differs") : null, frame);
      return;
    }
    const strip = h("canvas", { "aria-hidden": "true", width: 240, height: 1 }), context = strip.getContext("2d");
    for (let i = 0; i < 240; i += 1) { context.fillStyle = rgb(cividis(i / 239)); context.fillRect(i, 0, 1, 1); }
    fill("map-legend", h("span", {}, text(low)), strip, h("span", {}, text(high)), frame);
  },

  cellAt(event) {
    if (!this.place || !this.answer) return null;
    const box = $("map-canvas").getBoundingClientRect(), { left, top, cell, tall } = this.place;
    const j = Math.floor((event.clientX - box.left - left) / cell), i = Math.floor((event.clientY - box.top - top) / tall);
    return i >= 0 && j >= 0 && i < this.answer.y.count && j < this.answer.x.count ? [i, j] : null;
  },
  point(at, aloud = false) {
    const { answer } = this;
    if (!answer) return;
    if (aloud) { this.cursor = at; this.redraw(); }
    if (!at) {
      $("map-said").textContent = `${count(answer.states, "state")} ${Object.keys(this.fixed).length ? "of this slice" : "in all"}. Click a cell to go to its first state.`;
      return;
    }
    const [i, j] = at, interval = (axis, k) => axis.width === 1 ? axis.low + k : `${axis.low + k * axis.width} to ${axis.low + (k + 1) * axis.width - 1}`;
    const value = answer.cells[i][j], number = answer.counts ? 0 : answer.count[i][j];
    const shown = !number ? "no state" : value === null ? (answer.terminal[i][j] === number ? "terminal" : "no value")
      : answer.what === "best_action" ? (value < 0 ? "different actions" : world.about.actions[value]) : text(value, 6);
    const line = `${answer.x.name} ${interval(answer.x, j)}, ${answer.y.name} ${interval(answer.y, i)}: ${shown}${number > 1 ? ` (${count(number, "state")})` : ""}`;
    $("map-said").textContent = line;
    if (aloud) say(line);
  },
  redraw() { const said = $("map-said").textContent; this.draw(); $("map-said").textContent = said; },
  go(at) { if (at && this.answer.state[at[0]][at[1]] >= 0) go(this.answer.state[at[0]][at[1]]); },
  key(event) {
    const moves = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
    if (!this.answer) return;
    if (moves) {
      const [i, j] = this.cursor || this.here() || [0, 0], clip = (value, n) => Math.max(0, Math.min(n - 1, value));
      this.point([clip(i + moves[0], this.answer.y.count), clip(j + moves[1], this.answer.x.count)], true);
    } else if (event.key === "Enter") this.go(this.cursor); else return;
    event.preventDefault(); event.stopPropagation();
  },
};

function swatch(color, border) {
  const made = h("i");
  made.style.background = color;
  if (border) made.style.border = border;
  return made;
}
