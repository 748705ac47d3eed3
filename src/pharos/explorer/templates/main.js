// What is shown now, and what keys and clicks do.
const world = { about: null, here: null, walk: [], start: [0, null], isOver: false };  // isOver: ended without a state

const say = (line) => { $("said").textContent = line; };

async function attempt(what) {
  try {
    const answer = await what();
    $("problem").hidden = true;
    return answer;
  } catch (error) {
    $("problem").textContent = error.message;
    $("problem").hidden = false;
    return null;
  }
}

// Go to a position; with `move`, as one more of the user's moves, else the walk begins anew there.
async function go(state, previous = null, move = null) {
  const asked = (go.asked = (go.asked || 0) + 1);
  const position = await attempt(() => source.ask("position", { state, previous }));
  if (!position || asked !== go.asked) return false;
  const before = world.here;
  world.isOver = false;
  if (move) world.walk.push(move); else if (!move && move !== false) { world.walk = []; world.from = [position.state, position.previous]; }
  world.here = position;
  panels.here(position, before);
  panels.choices(position);
  panels.moves();
  if (maps.answer) maps.redraw();
  history.replaceState(null, "", `#${position.state}${position.previous === null ? "" : `,${position.previous}`}`);
  const last = world.walk.at(-1);
  say(`${move ? `${world.about.actions[last.action]}, reward ${text(last.reward)}, regret ${text(last.gap > world.about.tie_tolerance ? last.gap : 0)}. ` : ""}State ${position.state}, ${position.terminal ? "terminal" : `optimal value ${text(position.v.optimal)}`}.`);
  return true;
}

// The user chose an action, and this is what came of it.
function moved(action, [state, previous, , reward]) {
  const { here } = world;
  if (world.isOver) return null;
  const move = { state: here.state, previous: here.previous, action, reward, gap: here.actions[action].gap };
  if (state === null) {
    world.walk.push(move);
    world.isOver = true;
    panels.moves();
    panels.ended(move);
    say(`The episode has ended. Reward ${text(reward)}.`);
    return null;
  }
  return go(state, previous, move);
}

function act(action) {
  const { here } = world;
  if (!here || world.isOver || !here.actions[action]?.available) return null;
  let left = Math.random();
  const { outcomes } = here.actions[action];
  return moved(action, outcomes.find(([, , probability]) => (left -= probability) < 0) || outcomes[0]);
}

// Back to before the move number i.
function back(i) {
  const move = world.walk[i];
  if (!move) return null;
  world.walk.length = i;
  return go(move.state, move.previous, false);
}

function again() {
  const [state, previous] = world.walk.length ? [world.walk[0].state, world.walk[0].previous] : world.start;
  return go(state, previous);
}

const KEYS = { ArrowUp: "up", ArrowDown: "down", ArrowLeft: "left", ArrowRight: "right", " ": "space" };

function pressed(event) {
  if (!world.here || event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey) return;
  const { target } = event, isField = target.matches("input, select, textarea, summary"), isButton = target.matches("button, a");
  if (isField || (isButton && event.key === " ") || target.closest(".scroll, .map")) return;
  const key = KEYS[event.key] || event.key.toLowerCase(), { keys } = world.about;
  const does = key in keys ? () => act(keys[key]) : { u: () => back(world.walk.length - 1), r: again, o: best }[key];
  if (!does) return;
  event.preventDefault();
  panels.stop();
  does();
}

function best() {
  const action = chosenBy(world.here, "optimal");
  return action === null ? null : act(action);
}

// On wide screens a card takes as many rows of 2 pixels as it is high, so that both columns are filled.
const placed = new ResizeObserver((cards) => {
  for (const { target } of cards) target.style.setProperty("--rows", Math.ceil((target.offsetHeight + 14) / 2));
});

async function begin() {
  document.querySelectorAll(".card").forEach((card) => placed.observe(card));
  const about = await attempt(() => source.ask("about"));
  if (!about) return;
  world.about = about;
  world.start = [about.starts[0][0], null];
  $("facts").textContent = `${count(about.num_states, "state")}, ${about.num_terminal.toLocaleString("en")} terminal; ${count(about.num_actions, "action")}; discount ${about.gamma}; chance: ${about.chance || "none"}; values within ${text(about.error_bound, 2)} (proven)`;
  const names = { up: "\u2191", down: "\u2193", left: "\u2190", right: "\u2192" };
  fill("keys", "Keys: ", Object.entries(about.keys).map(([key, action]) => [h("kbd", {}, names[key] || key), ` ${about.actions[action]} `]), h("kbd", {}, "o"), " optimal action ", h("kbd", {}, "u"), " undo ", h("kbd", {}, "r"), " start again");
  await drawing.load(about.drawing);
  const [state, previous] = location.hash.slice(1).split(",").map((word) => (/^\d+$/.test(word) ? Number(word) : null));
  if (!(state !== null && state !== undefined && state < about.num_states && (await go(state, previous ?? null)))) await go(...world.start);
  if (!world.here) return;
  panels.initWay(); panels.loadWay(world.start);
  maps.init(about);
  panels.initLayers(); panels.initWrong();
  document.addEventListener("keydown", pressed);
  $("undo").addEventListener("click", () => back(world.walk.length - 1));
  $("restart").addEventListener("click", again);
  $("follow").addEventListener("click", best);
  $("goto").addEventListener("submit", async (event) => {
    event.preventDefault();
    $("goto-fault").textContent = "";
    try {
      const { state: found } = await source.ask("find", { text: $("wanted").value });
      await go(found);
    } catch (error) { $("goto-fault").textContent = error.message; }
  });
  const drawnAgain = () => { if (maps.answer) maps.redraw(); panels.strip(); if (panels.layer) panels.bars(); };
  let width = innerWidth, later = null;
  addEventListener("resize", () => {
    if (innerWidth === width) return;
    width = innerWidth;
    clearTimeout(later); later = setTimeout(drawnAgain, 60);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawnAgain);
  document.documentElement.dataset.ready = "yes";
}

begin();
