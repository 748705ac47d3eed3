// Where answers come from: the server that the page came from, or the data that it holds.
const held = JSON.parse(document.getElementById("data").textContent);

const source = held ? ofData(held) : {
  async ask(question, words = {}) {
    const query = new URLSearchParams();
    for (const [name, value] of Object.entries(words)) if (value !== null && value !== undefined) query.set(name, value);
    let reply;
    try {
      reply = await fetch(`${question}?${query}`, { credentials: "omit" });
    } catch {
      throw new Error("The server does not answer: was `pharos explore` ended?");
    }
    const answer = await reply.json();
    if (!reply.ok) throw new Error(answer.error || reply.statusText);
    return answer;
  },
};

// The same answers as those of the server (exploration.py, maps.py), from a table of all positions.
function ofData(data) {
  const { about, positions, fields, wrong } = data;
  const place = (state, previous) => positions[previous === null || previous === undefined ? `${state}` : `${state},${previous}`];
  const numbers = Array.from({ length: about.num_states }, (_, s) => s);

  function position({ state, previous }) {
    const found = place(state, previous);
    if (!found) throw new Error(`there is no state ${state}; expected 0 to ${about.num_states - 1}`);
    return found;
  }

  function find({ text }) {
    const values = text.split(/[\s,]+/).filter(Boolean).map(Number);
    if (!values.length || values.some((value) => !Number.isInteger(value))) {
      throw new Error("expected the number of a state, or its values such as 2,3,1");
    }
    if (values.length === 1) return { state: position({ state: values[0] }).state };
    const state = numbers.find((s) => place(s).values.join() === values.join());
    if (state === undefined) throw new Error(`state (${values.join(", ")}) is not reachable from the start`);
    return { state };
  }

  function path({ policy, state, previous }) {
    const steps = [], seen = new Set();
    let at = [Number(state), previous ?? null], why = "limit";
    while (steps.length < 2000) {
      const here = at[0] === null ? null : place(...at);
      if (here === null || here.terminal) { why = "end"; break; }
      seen.add(`${at}`);
      const chances = here.actions.map((each) => each.policies[policy]);
      if (chances.includes(null)) { why = "unknown"; break; }
      const action = chances.indexOf(Math.max(...chances));
      const outcome = here.actions[action].outcomes.find(([s, b]) => !seen.has(`${[s, b]}`));
      if (!outcome) { why = "circle"; break; }
      steps.push([...at, action, outcome[2], outcome[3], here.actions[action].gap]);
      at = [outcome[0], outcome[1]];
    }
    return { steps, stops: at, why };
  }

  function layer({ layer, first = 0 }) {
    const all = numbers.filter((s) => place(s).layer === Number(layer));
    const states = all.slice(first, Number(first) + 48).map((s) => [s, place(s).v.optimal, place(s).terminal]);
    return { layer: Number(layer), first: Number(first), count: all.length, states };
  }

  function map(words) {
    const axis = (name) => about.axes.find((each) => each.name === name);
    const names = about.variables.map((each) => each.name);
    const fixed = Object.entries(words).filter(([name]) => name.startsWith("fix.")).map(([name, value]) => [names.indexOf(name.slice(4)), Number(value)]);
    const at = (each, values) => {  // as Axis.indices
      const part = Math.floor((values[each.variable] - each.origin) / each.divisor);
      return Math.floor((each.modulus ? part % each.modulus : part) / each.width);
    };
    const x = axis(words.x), y = axis(words.y);
    const grid = (value) => Array.from({ length: y.count }, () => Array(x.count).fill(value));
    const several = Array.from({ length: y.count }, () => Array.from({ length: x.count }, () => []));
    const count = grid(0), terminal = grid(0), state = grid(-1), cells = grid(null);
    let low = null, high = null, states = 0;
    for (const s of numbers) {
      const here = place(s);
      if (fixed.some(([i, value]) => here.values[i] !== value)) continue;
      const row = at(y, here.values), column = at(x, here.values);
      states += 1; count[row][column] += 1;
      if (here.terminal) terminal[row][column] += 1;
      if (state[row][column] < 0) state[row][column] = s;
      if (fields[words.what][s] !== null) several[row][column].push(fields[words.what][s]);
    }
    const summary = {
      mean: (values) => values.reduce((a, b) => a + b, 0) / values.length,
      least: (values) => Math.min(...values), most: (values) => Math.max(...values), sum: (values) => values.reduce((a, b) => a + b, 0),
    }[words.how];
    several.forEach((row, i) => row.forEach((values, j) => {
      if (!values.length) return;
      const same = values.every((value) => value === values[0]);
      const value = words.what === "best_action" ? (same ? values[0] : -1) : summary(values);
      cells[i][j] = value;
      low = low === null ? value : Math.min(low, value); high = high === null ? value : Math.max(high, value);
    }));
    return { x, y, what: words.what, how: words.how, cells, count, terminal, state, low, high, states };
  }

  const answers = { about: () => about, position, find, path, layer, map, wrong: ({ policy }) => wrong[policy] };
  return { ask: async (question, words = {}) => answers[question](words) };
}
