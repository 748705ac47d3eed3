"""The explorer's page in Chromium without a screen: keys, clicks, wide and narrow, dark and light.

Skipped where there is no Chromium; CONTRIBUTING.md says how to get one.
"""

import json

import numpy as np
import pytest

import headless
from pharos.explorer import Exploration, Explorer, Learnt, exploration_of, write
from pharos.explorer.launch import QUESTIONS
from pharos.mdp import TabularMDP

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(headless.program() is None, reason="there is no Chromium; see CONTRIBUTING.md"),
]


@pytest.fixture(scope="module")
def world():
    """The lake of 4 x 4 cells, and a policy that turns round at the fourth step of the optimal way."""
    plain = exploration_of("frozen_lake/4x4")
    table = np.array(plain.solutions["optimal"].policy)
    step = plain.path("optimal", 0)["steps"][3]
    table[step[0]] = (step[2] + 2) % 4
    return exploration_of("frozen_lake/4x4", learnt=Learnt(table, "turned"))


@pytest.fixture(scope="module")
def url(world, tmp_path_factory):
    """Its page in a file."""
    return write(world, tmp_path_factory.mktemp("page") / "lake.html").as_uri()


@pytest.fixture(scope="module")
def browser():
    with headless.Page() as page:
        yield page


@pytest.fixture
def page(browser, url):
    """The page at its start, in a window of 1280 pixels."""
    browser.size(1280)
    browser.faults.clear()
    browser.open(url)
    yield browser
    assert browser.faults == []


def at(page, state):
    """Wait until a state is shown."""
    page.until(f"document.getElementById('here-title').innerText === 'State {state}'")


def test_keys_play_and_each_move_is_charged_its_gap(page, world):
    page.press("ArrowRight")
    at(page, 2)
    page.press("d")
    at(page, 5)
    page.press("4")  # up, into the shore
    page.until("document.querySelectorAll('#moves tbody tr').length === 3")
    gap = world.position(5)["actions"][3]["gap"]
    lost = page.value("world.walk.reduce((all, move, i) => all + world.about.gamma ** i * move.gap, 0)")
    assert lost == pytest.approx(0.99**2 * gap, rel=1e-9)
    assert "1 not optimal" in page.text("#walk-tiles")
    page.press("u")
    page.until("document.querySelectorAll('#moves tbody tr').length === 2")
    page.press("r")
    at(page, 0)
    assert page.value("world.walk.length") == 0


def test_the_optimal_action_by_key_leads_to_the_end(page, world):
    path = world.path("optimal", 0)
    for step in [*path["steps"][1:], path["stops"]]:
        page.press("o")
        at(page, step[0])
    assert "terminal" in page.text("#badges") and "A terminal state" in page.text("#actions")
    assert page.value("world.walk.reduce((all, move) => all + move.reward, 0)") == 1
    page.press("o")  # does nothing any more
    assert page.value("world.walk.length") == len(path["steps"])


def test_clicks_lead_to_successors_to_cells_of_the_map_and_to_states_of_a_layer(page, world):
    page.click("#actions tbody tr:nth-child(2) .chips button")  # down
    at(page, 1)
    row, column = world.space.state(9)
    size = "{ w: $('map-canvas').clientWidth, h: $('map-canvas').clientHeight }"
    place = page.value(f"({{ ...maps.place, ...{size} }})")
    x = (place["left"] + (column + 0.5) * place["cell"]) / place["w"]
    y = (place["top"] + (row + 0.5) * place["tall"]) / place["h"]
    page.click("#map-canvas", x, y)
    at(page, 9)
    page.click("#layers-bars", 2.5 / 7)
    page.until("document.querySelectorAll('#layer-states button').length === 3")
    page.click("#layer-states button:nth-child(3)")
    at(page, 5)
    page.value("document.getElementById('wanted').focus()")
    for key in "3, 2":
        page.press(key)  # in a field a key is a letter, not a move
    at(page, 5)
    page.press("Enter")
    at(page, world.space.index((3, 2)))
    page.value("document.getElementById('wanted').value = '9,9'")
    page.click("#goto button")
    page.until("document.getElementById('goto-fault').innerText.includes('not reachable')")


def test_the_map_is_walked_by_keys(page, world):
    page.value("document.getElementById('map-canvas').focus({ focusVisible: true })")
    page.press("ArrowDown")
    page.press("ArrowDown")
    page.press("ArrowRight")
    assert page.text("#map-said").startswith("column 1, row 2: 0.")
    page.press("Enter")
    at(page, world.space.index((2, 1)))
    assert page.value("world.walk.length") == 0


def test_the_way_of_what_was_learnt_shows_where_it_goes_wrong(page, world):
    assert "1 action not optimal" in page.text("#way-said")
    assert "step 4" in page.text("#wrong-first")
    page.click("#wrong-first button")
    at(page, world.wrong("learnt")["first"]["step"][0])
    page.click("#way-play")
    stop = world.path("learnt", 0)["stops"][0]
    at(page, stop)
    page.until("document.getElementById('way-play').getAttribute('aria-pressed') === 'false'")


def test_a_page_of_its_own_answers_as_the_server_does(page, world):
    questions = [("path", {"policy": name, "state": state}) for name in world.policies for state in (0, 3)]
    questions += [
        ("layer", {"layer": 2}),
        ("find", {"text": "2 1"}),
        ("wrong", {"policy": "learnt"}),
        ("position", {"state": 4}),
    ]
    questions += [
        ("map", {"x": "column", "y": "row", "what": what, "how": how, **fixed})
        for what in ("value", "regret_learnt", "best_action", "layer", "visits_learnt")
        for how, fixed in (("mean", {}), ("sum", {"fix.row": 2}))
    ]
    for question, words in questions:
        told = page.value(f"source.ask({json.dumps(question)}, {json.dumps(words)})")
        expected = QUESTIONS[question](world, {name: str(value) for name, value in words.items()})
        assert_same(told, json.loads(json.dumps(expected)), question)


def assert_same(told, expected, where):
    if isinstance(expected, dict):
        assert told.keys() == expected.keys(), where
        for name in expected:
            assert_same(told[name], expected[name], f"{where}.{name}")
    elif isinstance(expected, list):
        assert len(told) == len(expected), where
        for i, each in enumerate(expected):
            assert_same(told[i], each, f"{where}[{i}]")
    elif isinstance(expected, float):
        assert told == pytest.approx(expected, rel=1e-9, abs=1e-11), where
    else:
        assert told == expected, where


@pytest.mark.parametrize("width", [320, 390, 768, 1024, 1280, 1920])
def test_nothing_is_wider_than_the_window(page, width):
    page.size(width)
    page.value("new Promise((done) => setTimeout(done, 200))")
    assert page.value("document.documentElement.scrollWidth") <= width
    outside = page.value(
        "[...document.querySelectorAll('main button, main select, main table, main canvas, main dl')]"
        ".filter((each) => each.offsetWidth && !each.closest('.map, .scroll, .sliders') && "
        "each.getBoundingClientRect().right > each.closest('.card').getBoundingClientRect().right + 0.5)"
        ".map((each) => each.id || each.outerHTML.slice(0, 80))"
    )
    assert outside == []
    over = page.value(
        "(() => { const boxes = [...document.querySelectorAll('.card')].map((each) => each.getBoundingClientRect());"
        "return boxes.flatMap((a, i) => boxes.slice(i + 1).filter((b) => a.left < b.right - 1 && b.left < a.right - 1 "
        "&& a.top < b.bottom - 1 && b.top < a.bottom - 1)).length; })()"
    )
    assert over == 0
    gaps = page.value(  # between a card and the next one below it in its column
        "(() => { const boxes = [...document.querySelectorAll('.card')].map((each) => each.getBoundingClientRect());"
        "return boxes.map((a) => Math.min(...boxes.filter((b) => b.left === a.left && b.top > a.top)"
        ".map((b) => b.top - a.bottom))).filter(Number.isFinite); })()"
    )
    assert len(gaps) == (5 if width >= 940 else 6) and all(13 <= gap <= 18 for gap in gaps)


@pytest.mark.parametrize("dark", [False, True])
def test_text_stands_out_from_what_is_behind_it(url, dark):
    """At least 4.5 to 1: WCAG 2.1, success criterion 1.4.3."""
    with headless.Page(dark=dark) as page:
        page.open(url)
        page.press("ArrowLeft")
        page.until("document.querySelectorAll('#moves tbody tr').length === 1")
        low = page.value(CONTRASTS)
        back = page.value("getComputedStyle(document.documentElement).backgroundColor")
    assert low == []
    assert (sum(map(int, back.strip("rgb()").split(","))) < 3 * 64) == dark


CONTRASTS = """(() => {
  const parts = (color) => {
    const context = document.createElement("canvas").getContext("2d");
    context.fillStyle = color;
    context.fillRect(0, 0, 1, 1);
    return [...context.getImageData(0, 0, 1, 1).data];
  };
  const linear = (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const light = (color) => {
    const [r, g, b] = color.map((v) => linear(v / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (each) => {
    for (let at = each; at; at = at.parentElement) {
      const color = parts(getComputedStyle(at).backgroundColor);
      if (color[3] > 250) return color;
    }
    return [255, 255, 255, 255];
  };
  const low = [];
  for (const each of document.querySelectorAll("body *")) {
    const says = [...each.childNodes].some((child) => child.nodeType === 3 && child.textContent.trim());
    if (!says || !each.offsetWidth || each.closest(".unseen, script, style, [disabled]")) continue;
    const [a, b] = [light(parts(getComputedStyle(each).color)), light(behind(each))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < 4.5) low.push(`${each.tagName} ${each.className} ${each.textContent.slice(0, 30)}: ${ratio}`);
  }
  return low;
})()"""


def test_everything_that_takes_the_focus_has_a_name(page):
    page.send("Accessibility.enable")
    nodes = page.send("Accessibility.getFullAXTree")["nodes"]
    unnamed = []
    for node in nodes:
        focusable = any(
            each["name"] == "focusable" and each["value"].get("value") for each in node.get("properties", [])
        )
        is_control = focusable and not node["ignored"] and node["role"]["value"] not in ("RootWebArea", "generic")
        if is_control and not node.get("name", {}).get("value"):
            unnamed.append(node["role"]["value"])
    page.send("Accessibility.disable")
    assert len(nodes) > 100 and unnamed == []


def test_an_episode_that_ends_without_a_state_is_over(browser, tmp_path):
    mdp = TabularMDP.from_arrays([[1, -1], [0, -1]], [[0.0, 2.0], [0.0, 1.0]], gamma=0.9)
    browser.size(1280)
    browser.open(write(Exploration(mdp, title="two states"), tmp_path / "two.html").as_uri())
    browser.press("2")
    browser.until("document.getElementById('badges').innerText.includes('ended after it')")
    for key in ("1", "2", "o"):
        browser.press(key)
    assert browser.value("world.walk.map((move) => move.reward)") == [2]
    browser.press("u")
    browser.press("1")
    at(browser, 1)
    assert "There is no drawing" in browser.text("#no-drawing")
    assert browser.faults == []


def test_the_served_page_works_under_its_policy_of_contents(browser, world):
    browser.faults.clear()
    with Explorer(world) as explorer:
        browser.open(f"{explorer.url}#5")
        at(browser, 5)
        browser.press("ArrowLeft")
        at(browser, world.position(5)["actions"][0]["outcomes"][0][0])
        assert browser.value("document.getElementById('drawing').width") > 100
        assert browser.faults == []
    browser.press("r")
    browser.until("document.getElementById('problem').innerText.includes('The server does not answer')")
    browser.faults.clear()
