"""Opening the explorer: from an environment, a state space, an MDP or the folder of a run to a page in the browser.

`Explorer` is a small local server of the page: one address, one token, GET alone, no files. It listens on the loopback
interface. A request is answered if its Host header names this server (a page from elsewhere whose name was led here
by DNS does not) and if its path begins with the token, compared in constant time. Answers come from a table of
questions. No part of a request ever names a file.
"""

import contextlib
import hmac
import json
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import parse_qs, urlsplit

from pharos.environments import Environment, class_called, make
from pharos.errors import ParameterError, PharosError
from pharos.explorer.exploration import Exploration
from pharos.explorer.pages import POLICY_OF_SERVER, check_page_size, explorer_page, heat_map, write
from pharos.explorer.states import Learnt
from pharos.mdp import TabularMDP
from pharos.policies import PolicyLike
from pharos.state_space import StateSpace, build, load
from pharos.training import ChanceSetting, Task, load_agent, read_record

HOST = "127.0.0.1"
HOST_NAMES = (HOST, "localhost")  # that a Host header may have
LONGEST_QUERY = 8192  # characters
REQUEST_SECONDS = 30  # of waiting for the next bytes of a request
FREE_SECONDS = 5  # of waiting for the place of a connection that was ended
MOST_CONNECTIONS = 64  # at once; a thread each


class Explorer:
    """A page that is served on the loopback interface until `close` is called, or the process ends.

    Args:
        exploration: what it shows.
        port: 0 for any that is free.
    Attributes:
        url: of the page, with an access token. It can be reached from this machine only.
    Raises:
        ParameterError: the port is taken, or may not be used.
    """

    def __init__(self, exploration: Exploration, *, port: int = 0):
        self.exploration, self.token = exploration, secrets.token_urlsafe(24)
        self.lock = threading.Lock()  # compiled loops may not run in two threads at once
        try:
            self._http = _Http((HOST, port), _Handler)
        except OSError as error:
            raise ParameterError(
                f"port {port} of {HOST}: {error.strerror or error}; choose another, or leave it out for a free one"
            ) from error
        except OverflowError as error:
            raise ParameterError(f"port {port}; expected 0 to 65535") from error
        self._http.owner = self
        self.port = int(self._http.server_address[1])
        self.url = f"http://{HOST}:{self.port}/{self.token}/"
        self.hosts = frozenset(f"{name}:{self.port}" for name in HOST_NAMES)
        self._page = explorer_page(exploration).encode()
        self._thread = threading.Thread(
            target=self._http.serve_forever, args=(0.2,), name="pharos explorer", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop answering, and give the port back."""
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()

    def wait(self) -> None:
        """Return when the process is interrupted (Ctrl-C)."""
        with contextlib.suppress(KeyboardInterrupt):
            while self._thread.is_alive():
                self._thread.join(0.5)

    def __enter__(self) -> "Explorer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Explorer({self.exploration.title}, {self.url})"

    def answer(self, path: str, query: str) -> tuple[HTTPStatus, str, bytes]:
        """HTTP status, content type and content for the path after the token."""
        if path == "":
            return HTTPStatus.OK, "text/html; charset=utf-8", self._page
        if path not in QUESTIONS or len(query) > LONGEST_QUERY:
            return _plain_text(HTTPStatus.NOT_FOUND, "there is nothing there")
        words = {name: values[-1] for name, values in parse_qs(query, keep_blank_values=True).items()}
        try:
            with self.lock:
                answer = QUESTIONS[path](self.exploration, words)
        except PharosError as error:
            return _plain_text(HTTPStatus.BAD_REQUEST, str(error))
        except MemoryError:
            return _plain_text(HTTPStatus.INSUFFICIENT_STORAGE, "out of memory")
        return HTTPStatus.OK, "application/json", json.dumps(answer, allow_nan=False).encode()


def _plain_text(status: HTTPStatus, text: str) -> tuple[HTTPStatus, str, bytes]:
    return status, "application/json", json.dumps({"error": text}).encode()


# Questions ------------------------------------------------------------------------------------------------------------


def _whole(words: Mapping[str, str], name: str, otherwise: int | None = None) -> int:
    """An integer from a query, `otherwise` if absent."""
    text = words.get(name, "")
    if text == "":
        if otherwise is None:
            raise ParameterError(f"{name} is missing")
        return otherwise
    if not (text.isascii() and text.removeprefix("-").isdigit() and len(text) < 20):
        raise ParameterError(f"{name} is {text[:40]!r}; expected a whole number")
    return int(text)


def _previous(words: Mapping[str, str]) -> int | None:
    return _whole(words, "previous") if words.get("previous") else None


def _heat_map(world: Exploration, words: Mapping[str, str]) -> dict[str, Any]:
    fixed = {name.removeprefix("fix."): _whole(words, name) for name in words if name.startswith("fix.")}
    names = {name: words.get(name, "") for name in ("x", "y", "what", "how")}
    return heat_map(world, **names, fixed=fixed)


QUESTIONS: dict[str, Callable[[Exploration, Mapping[str, str]], dict[str, Any]]] = {
    "about": lambda world, _: world.about(),
    "position": lambda world, words: world.position(_whole(words, "state"), _previous(words)),
    "find": lambda world, words: world.find(words.get("text", "")),
    "path": lambda world, words: world.path(words.get("policy", ""), _whole(words, "state"), _previous(words)),
    "layer": lambda world, words: world.layer(_whole(words, "layer"), _whole(words, "first", 0)),
    "wrong": lambda world, words: world.wrong(words.get("policy", "")),
    "map": _heat_map,
}


# HTTP -----------------------------------------------------------------------------------------------------------------


Request: TypeAlias = socket.socket | tuple[bytes, socket.socket]
Address: TypeAlias = tuple[str, int] | str


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    owner: Explorer

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]):
        self.connections = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self.incomplete: dict[socket.socket, None] = {}  # whose requests have not arrived, the oldest first
        super().__init__(address, handler)

    def process_request(self, request: Request, client_address: Address) -> None:
        """Give the connection a thread. If there is none left, the one that has waited longest for a request ends."""
        if not self.connections.acquire(blocking=False):
            with contextlib.suppress(StopIteration, OSError):  # of those that send a byte now and then
                next(iter(list(self.incomplete))).shutdown(socket.SHUT_RDWR)
            if not self.connections.acquire(timeout=FREE_SECONDS):
                self.shutdown_request(request)
                return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Request, client_address: Address) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.connections.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that went away in the middle of an answer is no error."""


class _Handler(BaseHTTPRequestHandler):
    timeout = REQUEST_SECONDS
    server: _Http
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "pharos", ""

    def setup(self) -> None:
        """Begin to wait for a request."""
        super().setup()
        self.server.incomplete[self.connection] = None

    def parse_request(self) -> bool:
        """Read a request, which is not incomplete any more."""
        is_whole = super().parse_request()
        self.server.incomplete.pop(self.connection, None)
        return is_whole

    def finish(self) -> None:
        """End the connection."""
        self.server.incomplete.pop(self.connection, None)
        super().finish()

    def do_GET(self) -> None:
        self._reply(with_content=True)

    def do_HEAD(self) -> None:
        self._reply(with_content=False)

    def refuse(self) -> None:
        """Refuse every HTTP method other than GET."""
        self._send(*_plain_text(HTTPStatus.METHOD_NOT_ALLOWED, "this server answers GET alone"), with_content=True)

    do_POST = do_PUT = do_PATCH = do_DELETE = do_OPTIONS = do_TRACE = do_CONNECT = refuse

    def _reply(self, with_content: bool) -> None:
        self._send(*self._answer(self.server.owner), with_content=with_content)

    def _send(self, status: HTTPStatus, kind: str, content: bytes, *, with_content: bool) -> None:
        self.close_connection = True  # so that nobody is answered after `close`
        self.send_response(status)
        self.send_header("Connection", "close")
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY_OF_SERVER)
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.end_headers()
        if with_content:
            self.wfile.write(content)

    def _answer(self, owner: Explorer) -> tuple[HTTPStatus, str, bytes]:
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or hosts[0].lower() not in owner.hosts:
            return _plain_text(HTTPStatus.MISDIRECTED_REQUEST, "this server answers to its own address alone")
        origin = self.headers.get("Origin")
        if origin is not None and origin.lower().removeprefix("http://") not in owner.hosts:
            return _plain_text(HTTPStatus.FORBIDDEN, "this server answers to its own page alone")
        try:
            parts = urlsplit(self.path)
        except ValueError:
            return _plain_text(HTTPStatus.BAD_REQUEST, "what was asked for is no address")
        token, _, rest = parts.path.removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), owner.token.encode()):
            return _plain_text(HTTPStatus.FORBIDDEN, "the address lacks the token that `pharos explore` printed")
        return owner.answer(rest, parts.query)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


# Launch ---------------------------------------------------------------------------------------------------------------


RUN_RECORD = "run.json"
GAMMA = 0.99
"""The discount, where none is given: values of states need one, as they belong to no number of steps to go."""


def explore(  # noqa: PLR0913
    target: str | os.PathLike | Environment | StateSpace | TabularMDP,
    *,
    policy: PolicyLike | None = None,
    gamma: float | None = None,
    sticky: float = 0.0,
    random: float = 0.0,
    lazy: float = 0.0,
    observation: object = "vector",
    trust: bool = False,
    out: str | os.PathLike | None = None,
    port: int = 0,
    browser: bool = True,
) -> Explorer | Path:
    """Show an MDP state by state in the browser.

    Args:
        target: an environment or its name, a state space, or the folder of one, a tabular MDP, or the folder of a
            finished run, whose chance and policy are taken.
        policy: one to set beside the optimal and the uniform policy, as `pharos.evaluate_policy` takes it.
        gamma: discount. Default: the discount of the MDP if it is below 1, else 0.99. A horizon is left out.
        sticky, random, lazy: chance that is added, see `pharos.sticky_actions`.
        observation: what `policy` sees, if it is no table.
        trust: whether code that a run names may be imported.
        out: write the page with all its data into this file instead, if the space is small enough (10,000 states).
        port: of the server. 0: any that is free.
        browser: whether to open the page in the browser.
    Returns:
        An Explorer, whose server answers until it is closed. With `out` the path of the file.
    Raises:
        ParameterError: there is no such target, the policy does not fit, the port is taken, or the space is too large
            for a file. DivergenceError: gamma is 1, and the value is infinite.
    """
    agent = None if policy is None else Learnt(policy, observation=observation)
    chance = ChanceSetting(sticky, random, lazy)
    world = exploration_of(target, learnt=agent, gamma=gamma, chance=chance, trust=trust, in_one_page=out is not None)
    if out is not None:
        return write(world, out)
    explorer = Explorer(world, port=port)
    if browser:
        open_browser(explorer.url)
    return explorer


def exploration_of(
    target: object,
    *,
    learnt: Learnt | None = None,
    gamma: float | None = None,
    chance: ChanceSetting | None = None,
    trust: bool = False,
    title: str = "",
    env: Environment | None = None,
    in_one_page: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> Exploration:
    """Exploration that `explore` shows. `title`, `progress`: as for `Exploration`. `env`: draws the states of an MDP.

    Args:
        in_one_page: whether it is for a page of its own. What is too large for that is refused before it is solved.
    """
    chance = chance or ChanceSetting()
    if isinstance(target, str | os.PathLike) and (Path(target) / RUN_RECORD).is_file():
        return _of_run(Path(target), learnt, gamma, chance, trust, title, progress)
    title = title or (target if isinstance(target, str) else "")
    if isinstance(target, str) and (class_called(target.partition("/")[0]) or not Path(target).exists()):
        target = make(target)
    elif isinstance(target, str | os.PathLike):
        target = load(target)
    if isinstance(target, Environment):
        progress("states")
        target = build(target)
    if isinstance(target, TabularMDP):
        mdp, space = target, None
        gamma = mdp.gamma if gamma is None and mdp.gamma < 1 else gamma
    elif isinstance(target, StateSpace):
        if target.environment is None:
            raise ParameterError(f"{target}: pharos does not know its class, so not its rewards; give the environment")
        space, env = target, target.environment
        mdp = space.mdp()
    else:
        raise ParameterError(f"target is {target!r}; expected an environment, a state space, an MDP or a folder")
    title = title or (_title(env) if env is not None else "")
    mdp_with_chance = chance.of(mdp.with_gamma(GAMMA if gamma is None else gamma))
    if in_one_page:
        check_page_size(mdp_with_chance, title or str(mdp), env)
    return Exploration(
        mdp_with_chance,
        env=env,
        space=space,
        learnt=learnt,
        title=title,
        chance=chance.in_words(mdp.dynamics.has_chance),
        progress=progress,
    )


def _of_run(
    folder: Path,
    learnt: Learnt | None,
    gamma: float | None,
    chance: ChanceSetting,
    trust: bool,
    title: str,
    progress: Callable[[str], None],
) -> Exploration:
    """The environment of a run with its chance, and its learned policy."""
    if chance:
        raise ParameterError(f"{folder}: a run has its chance already; leave out sticky, random and lazy")
    progress("what was learnt")
    task, agent = load_agent(folder, trust=trust)
    record = read_record(folder)
    if learnt is None:
        learnt = Learnt(
            agent,
            f"{record['config'].get('agent', 'agent')}, seed {record['config'].get('seed', 0)}",
            task.observation,
            task.observation_options,
            task.previous_action,
            _facts(record, task),
        )
    progress("states")
    space = task.space
    mdp = task.chance.of(space.mdp(gamma=GAMMA if gamma is None else gamma))
    title = title or _title(task.env)
    setting = task.chance.in_words(mdp.dynamics.has_chance)
    return Exploration(mdp, env=task.env, space=space, learnt=learnt, title=title, chance=setting, progress=progress)


def _facts(record: Mapping[str, Any], task: Task) -> dict[str, str]:
    """Facts that the run recorded, in its own setting."""
    result, config = record.get("result", {}), record["config"]
    limit = "discounted, no horizon" if task.horizon_steps is None else f"episodes of {task.horizon_steps} steps"
    facts = {"trained": f"{config.get('steps', 0):,} steps, observation {task.observation}", "its setting": limit}
    for name, word in (("value_optimal", "optimal value"), ("final_value", "value"), ("final_regret", "regret")):
        if isinstance(result.get(name), int | float):
            facts[f"{word} there"] = f"{result[name]:.6g}"
    return facts


def _title(env: Environment) -> str:
    """The environment as a command would name it. Parameters that were not passed are left out."""
    parameters = {name: value for name, value in env.parameters.items() if value is not None and value != ()}
    return " ".join([env.name, *(f"{name}={_short(value)}" for name, value in parameters.items())])


def _short(value: object) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def open_browser(url: str) -> bool:
    """Open a page in the user's browser. False if there is none, or no screen to show it on."""
    has_screen = bool({"DISPLAY", "WAYLAND_DISPLAY", "BROWSER"} & set(os.environ))
    if sys.platform.startswith("linux") and not has_screen:  # else a browser of the terminal would take it over
        return False
    try:
        return webbrowser.open(url)
    except (webbrowser.Error, OSError):
        return False
