"""The explorer: what its page is told agrees with the MDP written out, and its server answers to its page alone."""

import contextlib
import http.client
import json
import socket
from dataclasses import dataclass
from urllib.parse import urlsplit

import numpy as np
import pytest

import pharos
from command_line import run
from naive import mdp as naive_mdp
from patience import PATIENCE, wait_for
from pharos.environments import Environment, make
from pharos.errors import ParameterError, UnknownName
from pharos.explorer import Exploration, Explorer, Learnt, exploration_of, explorer_page, write
from pharos.explorer.exploration import Pictures
from pharos.explorer.launch import MOST_CONNECTIONS
from pharos.explorer.pages import contents, heat_map, quantities, quantity, smaller_instance
from pharos.explorer.states import NumberedStates, axes_of
from pharos.mdp import TabularMDP
from refusals import failing

TOLERANCE = 1e-6  # of values, as value_iteration promises


def small_mdp(gamma=0.9):
    """Five states, two actions, up to two outcomes; state 4 is terminal, and state 2 may end the episode."""
    successors = [[[1, 2], [0, 0]], [[2, 3], [4, 4]], [[-1, 0], [3, 3]], [[3, 1], [4, 2]], [[4, 4], [4, 4]]]
    probabilities = [[[0.7, 0.3], [1, 0]], [[0.5, 0.5], [1, 0]], [[0.4, 0.6], [1, 0]], [[0.2, 0.8], [0.9, 0.1]]]
    rewards = [[0, 0.1], [0.2, -1], [1, 0], [-0.3, 2], [0, 0]]
    return TabularMDP.from_outcomes(
        successors, [*probabilities, [[1, 0], [1, 0]]], rewards, gamma=gamma, terminal=np.arange(5) == 4
    )


@pytest.fixture(scope="module")
def sticky():
    """A world of every kind of chance, with a policy that was learnt."""
    mdp = pharos.random_actions(pharos.sticky_actions(small_mdp(), 0.25), 0.2)
    table = np.random.default_rng(0).dirichlet([1, 1], size=(5, 3))
    return Exploration(mdp, learnt=Learnt(table))


@pytest.fixture(scope="module")
def lake():
    """The lake of 4 x 4 cells."""
    return exploration_of("frozen_lake/4x4")


# What is told of a position -------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_position_tells_the_values_and_outcomes_of_the_mdp_written_out(sticky):
    P, R, _ = naive_mdp.augmented(sticky.mdp)
    q = R + 0.9 * P @ naive_mdp.optimal_values(P, R, 0.9)
    for state in range(4):
        for previous in (None, 0, 1):
            row = state * 3 + (2 if previous is None else previous)
            told = sticky.position(state, previous)
            assert told["v"]["optimal"] == pytest.approx(q[row].max(), abs=TOLERANCE)
            for action, each in enumerate(told["actions"]):
                assert each["q"] == pytest.approx(q[row, action], abs=TOLERANCE)
                assert each["gap"] == pytest.approx(q[row].max() - q[row, action], abs=2 * TOLERANCE)
                assert each["reward"] == pytest.approx(R[row, action])
                expected = np.zeros(len(P))
                for after, before, probability, _ in each["outcomes"]:
                    expected[-1 if after is None else after * 3 + before] += probability
                np.testing.assert_allclose(expected, P[row, action], atol=1e-12)


def test_values_of_policies_are_those_of_linear_systems(sticky):
    P, R, _ = naive_mdp.augmented(sticky.mdp)
    table = np.asarray(sticky.solutions["learnt"].policy)
    for name, policy in (("uniform", np.full((5, 3, 2), 0.5)), ("learnt", table)):
        v = naive_mdp.values_of(P, R, 0.9, np.concatenate([policy.reshape(15, 2), [[1.0, 0.0]]]))
        for state in range(5):
            assert sticky.position(state)["v"][name] == pytest.approx(v[state * 3 + 2], abs=TOLERANCE)
            assert sticky.position(state, 1)["v"][name] == pytest.approx(v[state * 3 + 1], abs=TOLERANCE)
            assert sticky.values(name, np.array([state]))[0] == pytest.approx(v[state * 3 + 2], abs=TOLERANCE)


@pytest.mark.parametrize("policy", ["uniform", "learnt", "optimal"])
def test_what_is_lost_in_all_states_sums_to_the_regret(sticky, policy):
    told = sticky.wrong(policy)
    assert told["lost"] == pytest.approx(told["regret"], abs=5 * TOLERANCE)
    assert told["lost"] == pytest.approx(sum(loss for _, loss, *_ in told["worst"]), abs=1e-5)


def test_the_first_wrong_action_is_the_first_whose_gap_is_no_tie(lake):
    table = np.array(lake.solutions["optimal"].policy)
    way = [step[0] for step in lake.path("optimal", 0)["steps"]]
    table[way[3]] = {0: 2, 1: 3, 2: 0, 3: 1}[table[way[3]]]  # turns round at the fourth step
    told = exploration_of("frozen_lake/4x4", learnt=Learnt(table)).wrong("learnt")
    assert told["first"]["number"] == 3
    assert told["first"]["step"][0] == way[3]


def test_rewards_of_outcomes_are_those_that_the_rules_pay():
    cliff = exploration_of("cliff_walking/4x12-slippery")
    env = cliff.env
    for state in (0, 1, 5):
        before = cliff.space.state(state)
        for action, each in enumerate(cliff.position(state)["actions"]):
            paid = {}
            for outcome in range(env.outcomes):
                if (p := env.probability(before, action, outcome)) > 0:
                    after = env.next_state(before, action, outcome)
                    place = cliff.space.index(after), env.reward_of(before, action, after, outcome)
                    paid[place] = paid.get(place, 0) + p
            assert {(s, r): p for s, _, p, r in each["outcomes"]} == pytest.approx(paid)


# Paths, layers, maps --------------------------------------------------------------------------------------------------


def test_the_optimal_path_ends_and_pays_the_optimal_value(lake):
    path = lake.path("optimal", 0)
    assert path["why"] == "end" and lake.mdp.terminal[path["stops"][0]]
    paid = sum(0.99**i * step[4] for i, step in enumerate(path["steps"]))
    assert paid == pytest.approx(lake.solutions["optimal"].value_at_start, abs=TOLERANCE)
    assert all(step[5] <= lake.tie_tolerance for step in path["steps"])


def test_a_path_that_only_comes_back_says_so(lake):
    table = np.zeros(16, np.int64)  # left, into the shore
    world = exploration_of("frozen_lake/4x4", learnt=Learnt(table))
    assert world.path("learnt", 0) == {"steps": [], "stops": [0, None], "why": "circle"}


def distances(mdp):
    """Steps from the start, by plain breadth-first search over what is possible."""
    level, frontier, known = 0, {int(s) for s in mdp.starts}, {}
    while frontier:
        known |= dict.fromkeys(frontier, level)
        after = {
            t
            for s in frontier
            if not mdp.terminal[s]
            for a in range(mdp.num_actions)
            for t, p in naive_mdp.outcomes(mdp, s, a)
            if p > 0 and t >= 0
        }
        frontier, level = after - set(known), level + 1
    return known


def test_layers_are_the_distances_from_the_start(lake, sticky):
    for world in (lake, sticky):
        expected = distances(world.mdp)
        assert {s: int(world.layers.of(np.array([s]))[0]) for s in expected} == expected
        for layer, count in enumerate(world.layers.counts):
            states = world.layers.states(layer).tolist()
            assert states == sorted(s for s, d in expected.items() if d == layer) and len(states) == count
        assert sum(world.layers.bars()["count"]) == len(expected)
        with pytest.raises(ParameterError, match="there is no layer"):
            world.layer(len(world.layers.counts))


@pytest.mark.parametrize("how", ["mean", "least", "most", "sum"])
def test_a_map_is_the_summary_of_the_states_of_each_cell(lake, how):
    told = heat_map(lake, "column", "row", "regret_uniform", how=how)
    for state in range(16):
        row, column = lake.space.state(state)
        value = quantity(lake, "regret_uniform", np.array([state]))[0]
        shown = told["cells"][row][column]
        assert (shown is None) == bool(lake.mdp.terminal[state]) == np.isnan(value)
        assert shown is None or shown == pytest.approx(value)
        assert told["state"][row][column] == state and told["count"][row][column] == 1
    assert told["states"] == 16


def test_a_slice_of_a_map_holds_the_states_that_have_its_values(lake):
    whole, part = (heat_map(lake, "column", "row", "layer", fixed=fixed) for fixed in ({}, {"row": 2}))
    assert part["cells"][2] == whole["cells"][2] and part["states"] == 4
    assert all(value is None for row in (0, 1, 3) for value in part["cells"][row])
    with pytest.raises(UnknownName, match="unknown variable 'lane'"):
        heat_map(lake, "column", "row", fixed={"lane": 1})


def test_states_without_variables_are_drawn_by_their_number(sticky):
    told = heat_map(sticky, "state", "all", "value")
    values = sticky.values("optimal", np.arange(4)).tolist()
    assert told["cells"] == [[*map(pytest.approx, values), None]]
    assert set(quantities(sticky)) >= {"value", "value_learnt", "regret_learnt", "visits_learnt", "best_action"}


@pytest.mark.parametrize("size", [25, 100, 30_000])
def test_many_states_without_variables_fill_rows(size):
    x, y = axes_of(NumberedStates(size)).values()
    places = y.indices(np.arange(size)) * x.count + x.indices(np.arange(size))
    assert (np.diff(np.unique(places)) == 1).all() and x.count <= 128 and y.count <= 128
    assert np.bincount(places).max() == y.width  # one state a cell, where there are cells enough
    assert size > 128**2 or y.width == 1


# Pages and their data -------------------------------------------------------------------------------------------------


def test_a_page_of_its_own_holds_every_position_and_loads_nothing(lake, tmp_path):
    text = write(lake, tmp_path / "lake.html").read_text()
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert set(data["positions"]) == {str(state) for state in range(16)}
    assert data["positions"]["1"]["actions"][0]["outcomes"] == lake.position(1)["actions"][0]["outcomes"]
    assert "http://" not in text and "https://" not in text
    assert "connect-src &#x27;none&#x27;" in text


def test_a_title_is_text_and_never_markup(lake, tmp_path):
    title = '</script><img src=x onerror="alert(1)">'
    text = explorer_page(Exploration(lake.mdp, title=title), contents(Exploration(lake.mdp, title=title)))
    assert "<img src=x" not in text and text.count("</script>") == 2


def test_a_space_that_does_not_fit_into_a_page_is_refused_in_one_line(monkeypatch, lake, tmp_path):
    monkeypatch.setattr("pharos.explorer.pages.MOST_POSITIONS", 15)
    with pytest.raises(ParameterError, match="has 16 states; a page of its own holds at most 15: choose a smaller"):
        write(lake, tmp_path / "lake.html")
    assert not list(tmp_path.iterdir())


@dataclass(frozen=True, kw_only=True)
class Square(Environment):
    """A square in which one walks right or down, for ever."""

    side: int = 9
    name = "square"
    actions = ("right", "down")

    def variables(self):
        return {"row": range(self.side), "column": range(self.side)}

    def initial_state(self):
        return (0, 0)

    def transition(self, state, action, out):
        out[action] = (state[action] + 1) % self.side

    def reward(self, state, action, next_state):
        return 0.0


@pytest.mark.parametrize(
    ("env", "most", "words"),
    [
        (make("frozen_lake", size=12, seed=1), 70, "frozen_lake/8x8 has 64"),
        (make("frozen_lake/8x8"), 20, "frozen_lake/4x4 has 16"),
        (make("frozen_lake/8x8"), 9, ""),
        (Square(), 80, "side=8 has 64"),
        (Square(), 24, "side=4 has 16"),
        (Square(side=1), 0, ""),
    ],
    ids=str,
)
def test_what_is_too_large_for_a_page_names_a_smaller_instance_if_there_is_one(env, most, words):
    assert smaller_instance(env, most) == words


def test_an_environment_without_a_drawing_is_shown_without_one(lake):
    undrawn = type("Undrawn", (type(lake.env),), {"draw": failing(RuntimeError("no\npicture"))})
    pictures = Pictures(undrawn(), (0, 0))
    assert pictures.fault == "There is no drawing: no picture"
    assert pictures.of((0, 0)) == {"fault": "There is no drawing: no picture"}


# The server -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def served(lake):
    with Explorer(lake) as explorer:
        yield explorer


def ask(explorer, path, method="GET", host=None, **headers):
    """(status, headers, text) of a request with this Host header."""
    at = urlsplit(explorer.url)
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", at.port, timeout=PATIENCE)) as connection:
        connection.putrequest(method, path, skip_host=True)
        for name, value in {"Host": host or at.netloc, **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        with connection.getresponse() as reply:
            return reply.status, reply.headers, reply.read().decode()


def test_the_page_and_its_answers_come_from_its_address(served):
    token = urlsplit(served.url).path
    status, headers, text = ask(served, token)
    assert status == 200 and "<title>frozen_lake/4x4" in text
    assert headers["Content-Security-Policy"].startswith("default-src 'none'")
    assert headers["Cache-Control"] == "no-store" and headers["Referrer-Policy"] == "no-referrer"
    status, _, text = ask(served, f"{token}position?state=4")
    assert status == 200 and json.loads(text) == served.exploration.position(4)
    status, _, text = ask(served, f"{token}map?x=column&y=row&what=layer&how=mean&fix.row=2")
    assert json.loads(text)["states"] == 4
    assert ask(served, token, host=f"localhost:{urlsplit(served.url).port}")[0] == 200


def test_it_listens_on_the_loopback_interface_alone(served):
    assert served._http.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:{port}", "[::1]:{port}"]
)
def test_a_request_to_another_host_is_refused(served, host):
    at = urlsplit(served.url)
    status, _, text = ask(served, at.path, host=host.format(port=at.port))
    assert status == 421 and "frozen_lake" not in text


@pytest.mark.parametrize("wrong", ["/", "/x/", "/{token}x/", "/{short}/", "/%C3%A9/", "/about", "/?{token}"])
def test_a_request_without_the_token_is_refused(served, wrong):
    token = urlsplit(served.url).path.strip("/")
    status, _, text = ask(served, wrong.format(token=token, short=token[:-1]))
    assert status == 403 and token not in text and "frozen_lake" not in text


@pytest.mark.parametrize(
    "path", ["../../etc/passwd", "%2e%2e/%2e%2e/etc/passwd", "templates/page.html", "about/", "..", "\\..\\x"]
)
def test_no_path_leads_to_a_file(served, path):
    status, _, text = ask(served, urlsplit(served.url).path + path)
    assert (status, json.loads(text)) == (404, {"error": "there is nothing there"})


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH"])
def test_other_methods_are_refused(served, method):
    assert ask(served, urlsplit(served.url).path, method)[0] == 405


@pytest.mark.parametrize("origin", ["http://[", "null", "http://evil.example", "https://[::1", "\u00e9"])
def test_an_origin_that_is_no_address_is_answered(served, origin):
    assert ask(served, urlsplit(served.url).path, Origin=origin.encode("latin-1"))[0] == 403


def test_a_target_that_is_no_address_is_answered(served):
    assert ask(served, "http://[")[0] == 400


def test_slow_clients_hold_no_places_of_others(served):
    """Clients that send a byte now and then: who has waited longest for a whole request makes room, one by one."""
    path, at = urlsplit(served.url).path, ("127.0.0.1", urlsplit(served.url).port)
    server = served._http
    with contextlib.ExitStack() as stack:
        slow = [stack.enter_context(socket.create_connection(at, timeout=PATIENCE)) for _ in range(MOST_CONNECTIONS)]
        for client in slow:
            client.sendall(b"GET / HT")
        wait_for(lambda: not server.connections._value and len(server.incomplete) == MOST_CONNECTIONS)
        for _ in range(15):
            assert ask(served, path)[0] == 200
            for client in slow:
                with contextlib.suppress(OSError):  # it was ended
                    client.sendall(b"T")
        with contextlib.suppress(ConnectionError):  # it was ended with or without a last word
            assert slow[0].recv(1) == b""
    wait_for(lambda: server.connections._value == MOST_CONNECTIONS)
    assert not server.incomplete and ask(served, path)[0] == 200


def test_another_pages_script_is_refused(served):
    path = urlsplit(served.url).path
    assert ask(served, f"{path}about", Origin="http://evil.example")[0] == 403
    assert ask(served, f"{path}about", Origin=served.url.rstrip("/").rsplit("/", 1)[0])[0] == 200


@pytest.mark.parametrize(
    ("question", "fault"),
    [
        ("position", "state is missing"),
        ("position?state=16", "there is no state 16; expected 0 to 15"),
        ("position?state=-1", "there is no state -1"),
        ("position?state=1e3", "expected a whole number"),
        ("path?policy=worst&state=0", "there is no policy 'worst'; expected optimal, uniform"),
        ("layer?layer=99", "there is no layer 99"),
        ("map?x=column&y=column&what=value&how=mean", "both axes are 'column'"),
        ("map?x=column&y=row&what=tokens&how=mean", "unknown quantity 'tokens'"),
        ("find?text=1,1,1", "a state has 2 components"),
        ("find?text=__import__", "expected the number of a state, or its values"),
    ],
)
def test_a_question_that_makes_no_sense_is_answered_in_one_line(served, question, fault):
    status, _, text = ask(served, urlsplit(served.url).path + question)
    assert status == 400 and fault in json.loads(text)["error"]


def test_a_state_is_found_by_its_number_and_by_its_values(lake):
    assert lake.find("12") == {"state": 12}
    assert lake.find("2, 1") == {"state": lake.space.index((2, 1))}


# The command ----------------------------------------------------------------------------------------------------------


def test_the_command_writes_a_page(tmp_path):
    done = run("explore", "frozen_lake/4x4", "--out", tmp_path / "lake.html")
    assert (done.exit_code, done.stdout) == (0, f"{tmp_path / 'lake.html'}\n")


def test_faults_of_the_command_are_one_line_each(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for words, code, fault in (
            (["frozen_lak"], 2, "did you mean 'frozen_lake'?"),
            (["no/such/folder/"], 2, "no such folder or file"),
            (["frozen_lake/4x4", "--out", "page.txt"], 2, "expected a file name that ends in .html"),
            (["frozen_lake/4x4", "--port", port], 2, f"port {port} of 127.0.0.1: Address already in use"),
            (["frozen_lake/4x4", "--policy", "best"], 2, "unknown policy 'best'"),
        ):
            done = run("explore", *words)
            assert done.exit_code == code and fault in done.stderr and done.stderr.count("\n") == 1, done.output
