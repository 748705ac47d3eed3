// The panels beside the map: actions, moves, ways, layers, where a policy goes wrong.
const NAMES = { optimal: "optimal", uniform: "uniform", learnt: "learnt" };
const chosenBy = (position, policy) => {
  const chances = position.actions.map((each) => each.policies[policy]);
  if (!chances.length || chances.includes(null)) return null;
  return chances.indexOf(Math.max(...chances));
};

function tile(label, value, note, kind) {
  return h("div", { class: "tile" }, h("span", {}, label), h("b", { class: kind }, value), note ? h("span", {}, note) : null);
}

function share(value) {
  const bar = h("i");
  bar.style.width = `${100 * (value || 0)}%`;
  return h("div", { class: "share" }, bar, h("b", {}, value === null ? "not asked" : percent(value)));
}

const panels = {
  keyOf(action) {
    const words = { up: "\u2191", down: "\u2193", left: "\u2190", right: "\u2192", space: "space" };
    const keys = Object.entries(world.about.keys).filter(([, a]) => a === action).map(([key]) => words[key] || key);
    return keys.sort((a, b) => /\d/.test(a) - /\d/.test(b))[0];
  },

  // Variables by name, those of an array together: a list of name, rows of numbers of variables
  groups() {
    if (this.grouped) return this.grouped;
    const groups = new Map();
    world.about.variables.forEach(({ name }, i) => {
      const [, base, index] = name.match(/^(.*?)(?:\[([\d,]+)\])?$/s), row = index ? index.split(",").slice(0, -1).join() : "";
      if (!groups.has(base)) groups.set(base, new Map());
      const rows = groups.get(base);
      rows.set(row, [...(rows.get(row) || []), i]);
    });
    this.grouped = [...groups].map(([name, rows]) => ({ name, rows: [...rows.values()] }));
    return this.grouped;
  },

  here(position, before) {
    const { about } = world;
    $("here-title").textContent = `State ${position.state.toLocaleString("en")}`;
    fill("badges",
      position.start ? h("span", {}, position.start === 1 ? "start" : `start, ${percent(position.start)}`) : null,
      position.layer >= 0 ? h("span", {}, `layer ${position.layer.toLocaleString("en")}`) : null,
      about.is_sticky ? h("span", {}, position.previous === null ? "no action before" : `before: ${about.actions[position.previous]}`) : null,
      (position.labels || []).map((label) => h("span", {}, label)),
      position.terminal ? h("span", { class: "end" }, "terminal") : null);
    fill("variables", this.groups().map(({ name, rows }) => {
      const changed = before && rows.flat().some((i) => before.values[i] !== position.values[i]);
      return h("div", { class: changed ? "changed" : null }, h("dt", {}, name), h("dd", {}, rows.map((row) => row.map((i) => position.values[i]).join(" ")).join("\n")));
    }));
    drawing.show(position);
    const told = about.variables.slice(0, 12).map(({ name }, i) => `${name} ${position.values[i]}`).join(", ");
    $("board").setAttribute("aria-label", `Drawing of state ${position.state}: ${told}`);
  },

  choices(position) {
    const { about } = world;
    fill("tiles", about.policies.map((policy) => {
      const action = policy === "uniform" ? null : chosenBy(position, policy);
      const does = position.terminal ? "the episode has ended" : policy === "uniform" ? "every action alike" : action === null ? "was not asked here" : `chooses ${position.actions[action].name ?? about.actions[action]}`;
      return tile(policy === "optimal" ? "optimal value V*" : `value, ${NAMES[policy]} policy`, text(position.v[policy], 6), does);
    }));
    if (position.terminal) { fill("actions", h("p", { class: "muted" }, "A terminal state: nothing follows, and its value is 0.")); $("choices-note").textContent = ""; return; }
    const widest = Math.max(...position.actions.map((each) => each.gap), 0), others = about.policies.filter((name) => name !== "optimal");
    const heads = ["Action", "Q*", "Gap", ...about.policies.map((name) => `${NAMES[name]}`), "Leads to"];
    const rows = position.actions.map((each, action) => {
      if (!each.available) return null;
      const bar = h("i");
      bar.style.width = each.best || !widest ? "0" : `${Math.max(2, (54 * each.gap) / widest)}px`;
      const gap = each.best ? h("span", { class: "none" }, "best") : h("span", { class: "gap" }, bar, h("span", {}, text(each.gap, 4)));
      const key = this.keyOf(action);
      return h("tr", { class: each.best ? "best" : null },
        h("td", { "data-label": "Action" }, h("button", { type: "button", class: "act", onclick: () => act(action) }, h("kbd", {}, key || " "), each.name ?? about.actions[action])),
        h("td", { class: "number", "data-label": "Q*", title: others.map((name) => `${NAMES[name]}: ${text(each.q_of[name], 6)}`).join(", ") }, text(each.q, 6)),
        h("td", { class: "number", "data-label": "Gap" }, gap),
        about.policies.map((name) => h("td", { "data-label": `${NAMES[name]}` }, share(each.policies[name]))),
        h("td", { "data-label": "Leads to" }, this.outcomes(each, action, position)));
    });
    const table = h("table", {}, h("thead", {}, h("tr", {}, heads.map((name, i) => h("th", { scope: "col", class: i === 1 || i === 2 ? "number" : null }, name)))), h("tbody", {}, rows));
    fill("actions", table);
    $("choices-note").textContent = `Q* is the value of choosing the action and playing optimally afterwards; a gap is what choosing it loses. Columns ${about.policies.map((name) => NAMES[name]).join(", ")} say how often each policy chooses it.`;
  },

  // The episode has ended without a state, as some tables have it
  ended(move) {
    $("badges").append(h("span", { class: "end" }, "ended after it"));
    fill("actions", h("p", { class: "muted" }, `After ${world.about.actions[move.action]} in this state the episode has ended. Undo, or start again.`));
  },

  outcomes(each, action, position, shown = 6) {
    const chip = ([state, previous, probability, reward]) => {
      const paid = reward ? ` ${reward > 0 ? "+" : ""}${text(reward, 3)}` : "";
      const chance = each.outcomes.length > 1 ? h("small", {}, ` ${percent(probability)}`) : null;
      const to = state === null ? "the end" : state === position.state && (previous === position.previous || previous === null) ? "stays" : `\u2192 ${state.toLocaleString("en")}`;
      const label = `${world.about.actions[action]}: ${state === null ? "the end" : `to state ${state}`}, chance ${percent(probability)}, reward ${text(reward)}`;
      return h("button", { type: "button", class: state === null ? "end" : null, "aria-label": label, title: label, onclick: () => moved(action, [state, previous, probability, reward]) }, to, chance, paid ? h("small", { class: reward < 0 ? "lost" : "won" }, paid) : null);
    };
    const chips = each.outcomes.slice(0, shown).map(chip), more = each.outcomes.length - shown;
    const list = h("div", { class: "chips" }, chips);
    if (more > 0) list.append(h("button", { type: "button", onclick: (event) => event.currentTarget.closest(".chips").replaceWith(this.outcomes(each, action, position, 1000)) }, `${more} more`));
    return list;
  },

  moves() {
    const { about, walk } = world, n = walk.length;
    let discount = 1, returned = 0, paid = 0, lost = 0;
    for (const move of walk) { returned += move.reward; paid += discount * move.reward; lost += discount * move.gap; discount *= about.gamma; }
    fill("walk-tiles", tile("moves", count(n, "move").replace(/ moves?/, "")), tile("return", text(returned, 5), about.gamma < 1 ? `discounted ${text(paid, 4)}` : null), tile("regret of your moves", text(lost, 5), n ? `${walk.filter((move) => move.gap > about.tie_tolerance).length} not optimal` : null, lost > about.tie_tolerance ? "lost" : "won"));
    $("walk-help").textContent = "Play by the keys of the actions, or click on one, or on a state that it leads to. Each move is charged its gap, what it loses against the best one, discounted.";
    const rows = walk.map((move, i) => h("tr", {}, h("td", {}, i + 1), h("td", {}, h("button", { type: "button", "aria-label": `back to state ${move.state}`, onclick: () => back(i) }, move.state.toLocaleString("en"))), h("td", {}, about.actions[move.action]), h("td", { class: "number" }, text(move.reward)), h("td", { class: `number ${move.gap > about.tie_tolerance ? "lost" : "won"}` }, move.gap > about.tie_tolerance ? text(move.gap, 4) : "0"))).reverse();
    fill("moves", n ? h("table", {}, h("thead", {}, h("tr", {}, ["", "State", "Move", "Reward", "Regret"].map((name, i) => h("th", { scope: "col", class: i > 2 ? "number" : null }, name)))), h("tbody", {}, rows)) : null);
    $("undo").disabled = !n;
  },

  // The way of a policy ----------------------------------------------------------------------------------------------
  way: null, playing: null,
  initWay() {
    fill("way-policy", world.about.policies.map((name) => h("option", { value: name }, name === "learnt" ? `learnt: ${world.about.learnt.name}` : name)));
    if (world.about.policies.includes("learnt")) $("way-policy").value = "learnt";
    $("way-controls").hidden = true;
    $("way-policy").addEventListener("change", () => this.loadWay(this.way ? this.way.from : world.start));
    $("way-here").addEventListener("click", () => this.loadWay([world.here.state, world.here.previous]));
    $("way-start").addEventListener("click", () => this.loadWay(world.start));
    $("way-step").addEventListener("input", () => { this.stop(); this.along(Number($("way-step").value)); });
    $("way-play").addEventListener("click", () => this.playing ? this.stop() : this.play());
    $("way-strip").addEventListener("click", (event) => {
      if (!this.way) return;
      const box = event.currentTarget.getBoundingClientRect();
      this.stop(); this.along(Math.round(((event.clientX - box.left) / box.width) * this.way.steps.length));
    });
  },
  async loadWay(from) {
    this.stop();
    const asked = (this.askedWay = (this.askedWay || 0) + 1), policy = $("way-policy").value;
    const way = await attempt(() => source.ask("path", { policy, state: from[0], previous: from[1] }));
    if (!way || asked !== this.askedWay) return;
    this.way = { ...way, from };
    const n = way.steps.length, { about } = world, wrong = way.steps.filter((step) => step[5] > about.tie_tolerance).length;
    let discounted = 0;
    way.steps.forEach((step, i) => { discounted += about.gamma ** i * step[4]; });
    const end = { end: "to the end", circle: "until it only comes back to where it was", limit: "and on", unknown: "to where the policy was not asked" }[way.why];
    const likely = way.steps.some((step) => step[3] < 1) ? ` Of chance, the likeliest outcome that is new; this way has probability ${text(way.steps.reduce((all, step) => all * step[3], 1), 3)}.` : "";
    $("way-said").textContent = `From state ${from[0].toLocaleString("en")}: ${count(n, "step")} ${end}, return ${text(way.steps.reduce((all, step) => all + step[4], 0))} (discounted ${text(discounted)}), ${wrong ? `${count(wrong, "action")} not optimal` : "every action optimal"}.${likely}`;
    $("way-controls").hidden = !n;
    $("way-step").max = n; $("way-step").value = 0;
    $("way-at").textContent = `0 of ${n}`;
    this.strip();
  },
  strip() {
    if (!this.way || !this.way.steps.length) return;
    const canvas = $("way-strip"), width = canvas.parentElement.clientWidth, { steps } = this.way;
    const context = sized(canvas, width, 26), each = width / (steps.length + 1), widest = Math.max(...steps.map((step) => step[5]));
    const at = Number($("way-step").value), gap = each > 6 ? 1 : 0;
    for (let i = 0; i <= steps.length; i += 1) {
      const wrong = i < steps.length && steps[i][5] > world.about.tie_tolerance, high = wrong ? 10 + (16 * steps[i][5]) / widest : 8;
      context.fillStyle = style(wrong ? "--bad" : i === steps.length ? "--muted" : "--bar");
      context.fillRect(i * each, 26 - high, Math.max(1, each - gap), high);
    }
    context.fillStyle = style("--accent");
    context.fillRect(at * each, 0, Math.max(2, each - gap), 26);
  },
  async along(i) {
    const { steps, stops } = this.way, to = i < steps.length ? steps[i] : stops;
    $("way-step").value = i;
    $("way-at").textContent = `${i} of ${steps.length}`;
    this.strip();
    if (to[0] !== null) await go(to[0], to[1]);
  },
  play() {
    if (!this.way || !this.way.steps.length) return;
    $("way-play").setAttribute("aria-pressed", "true"); $("way-play").textContent = "Pause";
    let i = Number($("way-step").value);
    if (i >= this.way.steps.length) i = -1;
    const next = async () => {
      if (!this.playing) return;
      i += 1;
      await this.along(i);
      if (!this.playing) return;
      if (i >= this.way.steps.length) this.stop(); else this.playing = setTimeout(next, 220);
    };
    this.playing = setTimeout(next, 0);
  },
  stop() {
    clearTimeout(this.playing); this.playing = null;
    $("way-play").setAttribute("aria-pressed", "false"); $("way-play").textContent = "Play";
  },

  // Layers -----------------------------------------------------------------------------------------------------------
  layer: null,
  initLayers() {
    const { about } = world;
    $("layer").max = about.num_layers - 1;
    const most = Math.max(...about.layers.count);
    $("layers-said").textContent = `${count(about.num_layers, "layer")}: the states whose shortest way from the start has 0, 1, ... ${(about.num_layers - 1).toLocaleString("en")} steps.${about.layers.first.length < about.num_layers ? ` A bar is ${about.layers.first[1]} layers.` : ""} The highest bar has ${count(most, "state")}.`;
    $("layer").addEventListener("input", () => { clearTimeout(this.layerTimer); $("layer-at").textContent = $("layer").value; this.layerTimer = setTimeout(() => this.loadLayer(Number($("layer").value)), 60); });
    $("layers-bars").addEventListener("click", (event) => {
      const box = event.currentTarget.getBoundingClientRect(), bar = Math.floor(((event.clientX - box.left) / box.width) * about.layers.first.length);
      this.loadLayer(about.layers.first[Math.max(0, Math.min(about.layers.first.length - 1, bar))]);
    });
    $("layer-before").addEventListener("click", () => this.loadLayer(this.layer.layer, this.layer.first - 48));
    $("layer-after").addEventListener("click", () => this.loadLayer(this.layer.layer, this.layer.first + 48));
    this.loadLayer(0);
  },
  async loadLayer(layer, first = 0) {
    const asked = (this.askedLayer = (this.askedLayer || 0) + 1);
    const answer = await attempt(() => source.ask("layer", { layer, first: Math.max(0, first) }));
    if (!answer || asked !== this.askedLayer) return;
    this.layer = answer;
    $("layer").value = layer;
    $("layer-at").textContent = `${layer.toLocaleString("en")}: ${count(answer.count, "state")}`;
    fill("layer-states", answer.states.map(([state, value, terminal]) => h("button", { type: "button", onclick: () => go(state) }, state.toLocaleString("en"), h("small", {}, terminal ? " end" : ` V* ${text(value, 3)}`))));
    $("layer-before").hidden = $("layer-after").hidden = answer.count <= 48;
    $("layer-before").disabled = !answer.first;
    $("layer-after").disabled = answer.first + answer.states.length >= answer.count;
    this.bars();
  },
  bars() {
    const canvas = $("layers-bars"), width = canvas.parentElement.clientWidth - 32, { first, count: counts } = world.about.layers;
    const context = sized(canvas, width, 120), each = width / counts.length, most = Math.max(...counts), gap = each > 5 ? 1 : 0;
    let here = first.findIndex((start) => start > this.layer.layer);
    here = (here < 0 ? first.length : here) - 1;
    counts.forEach((number, i) => {
      context.fillStyle = style(i === here ? "--accent" : "--bar");
      const high = Math.max(2, (112 * number) / most);
      context.fillRect(i * each, 120 - high, Math.max(0.7, each - gap), high);
    });
  },

  // Where a policy goes wrong ----------------------------------------------------------------------------------------
  initWrong() {
    const names = world.about.policies.filter((name) => name !== "optimal").reverse();
    names.sort((a, b) => (b === "learnt") - (a === "learnt"));
    fill("wrong-policy", names.map((name) => h("option", { value: name }, name === "learnt" ? `learnt: ${world.about.learnt.name}` : name)));
    $("wrong-policy").addEventListener("change", () => this.loadWrong());
    if (world.about.num_states <= 100000 || names[0] === "learnt") { this.loadWrong(); return; }
    $("wrong-first").textContent = "What this policy loses, state by state, takes some seconds here.";
    fill("wrong-states", h("button", { type: "button", onclick: () => this.loadWrong() }, "Compute"));
  },
  async loadWrong() {
    const policy = $("wrong-policy").value, { about } = world;
    fill("wrong-facts", h("dt", {}, "computing ..."));
    fill("wrong-states"); $("wrong-first").textContent = "";
    const answer = await attempt(() => source.ask("wrong", { policy }));
    if (!answer || policy !== $("wrong-policy").value) return;
    const facts = [["value at the start", text(about.value_at_start[policy], 6)], ["optimal value", text(about.value_at_start.optimal, 6)], ["regret", text(answer.regret, 6)]];
    if (policy === "learnt") facts.push(...Object.entries(about.learnt.facts));
    fill("wrong-facts", facts.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
    const goTo = (state, previous) => h("button", { type: "button", onclick: () => go(state, previous) }, `state ${state.toLocaleString("en")}`);
    const line = $("wrong-first");
    if (policy === "uniform") line.textContent = "It chooses every action alike; what that loses, state by state:";
    else if (answer.first) {
      const [state, previous, action, , , gap] = answer.first.step;
      line.replaceChildren("First wrong on its likely way: step ", String(answer.first.number + 1), ", in ", goTo(state, previous), `, where it chooses ${about.actions[action]} and loses ${text(gap)}.`);
    } else line.textContent = "Every action on its likely way is optimal.";
    const total = answer.lost || 1;
    const rows = answer.worst.map(([state, lost, visits, action]) => h("tr", {}, h("td", {}, goTo(state, null)), h("td", { class: "number lost" }, text(lost, 4)), h("td", {}, share(Math.min(1, lost / total))), h("td", { class: "number" }, text(visits, 4)), policy === "uniform" ? null : h("td", {}, about.actions[action])));
    const heads = ["State", "Loss", "of all", "Visits", ...(policy === "uniform" ? [] : ["Chooses"])];
    fill("wrong-states", rows.length ? h("table", {}, h("thead", {}, h("tr", {}, heads.map((name, i) => h("th", { scope: "col", class: i === 1 || i === 3 ? "number" : null }, name)))), h("tbody", {}, rows)) : h("p", { class: "won" }, "It loses nothing anywhere it gets to."));
  },
};
