// Small things that everything else uses, and the drawing of a state.
const $ = (id) => document.getElementById(id);

function h(tag, given = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children.flat(Infinity).filter((each) => each !== null && each !== undefined));
  return made;
}

const fill = (id, ...children) => $(id).replaceChildren(...children.flat(Infinity).filter((each) => each !== null && each !== undefined));
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const isDark = () => matchMedia("(prefers-color-scheme: dark)").matches;

function text(value, digits = 4) {
  if (value === null || value === undefined) return "-";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (Number.isInteger(value) && size < 1e7) return value.toLocaleString("en");
  if (size >= 1e6 || size < 1e-4) return value.toExponential(Math.max(0, digits - 2)).replace("e+", "e").replace("-", "\u2212").replace("e-", "e\u2212");
  return String(Number(value.toPrecision(digits))).replace("-", "\u2212");
}
const count = (number, one, several = `${one}s`) => `${number.toLocaleString("en")} ${number === 1 ? one : several}`;
const percent = (share) => share === null ? "-" : share >= 0.9995 ? "100 %" : share === 0 ? "0 %" : share < 0.001 ? "< 0.1 %" : `${Number((100 * share).toPrecision(3))} %`;

const ARROWS = { up: "\u2191", down: "\u2193", left: "\u2190", right: "\u2192" };
function sign(name) {
  const word = name.toLowerCase().split(" ").pop();
  return ARROWS[word] || (name.length <= 3 ? name : name.slice(0, 2));
}

// A canvas of so many CSS pixels, sharp on every screen; its context is in CSS pixels.
function sized(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  canvas.style.width = `${width}px`; canvas.style.height = `${height}px`;
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  return context;
}

const drawing = {
  kit: null, ground: null, tiles: null,

  async load(kit) {
    if (!kit || !kit.tiles) return;
    const loaded = (url) => new Promise((done) => { const image = new Image(); image.onload = () => done(image); image.onerror = () => done(null); image.src = url; });
    this.ground = await loaded(kit.ground);
    this.tiles = await Promise.all(kit.tiles.map((urls) => Promise.all(urls.map(loaded))));
    this.kit = kit;
  },

  show(position) {
    const canvas = $("drawing"), image = $("picture"), none = $("no-drawing");
    canvas.hidden = !position.cells; image.hidden = !position.picture; none.hidden = !position.fault;
    if (position.picture) image.src = position.picture;
    if (position.fault) none.textContent = position.fault;
    if (position.cells && this.kit) this.paint(canvas, position.cells);
  },

  paint(canvas, cells) {
    const { cell, margin } = this.kit;
    canvas.width = this.ground.width; canvas.height = this.ground.height;
    const context = canvas.getContext("2d");
    context.drawImage(this.ground, 0, 0);
    for (const [layer, row, column, value] of cells) {
      const kinds = this.tiles[layer], tile = kinds[Math.min(value, kinds.length) - 1];
      if (tile) context.drawImage(tile, margin + column * cell, margin + row * cell);
    }
  },
};
