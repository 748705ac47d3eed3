"""Short games, drawn frame by frame in golden/*.txt, to be read in review. `python tests/golden_games.py` writes them
anew.

Look at every frame that changed: a golden game is right because someone has read it.
"""

import re
from pathlib import Path

import pharos
from pharos.drawing import text_drawing

FOLDER = Path(__file__).with_name("golden")

# name of the file -> (environment, parameters, actions by their first letters, or as a list)
WALL = {"height": 5, "columns": 3, "brick_rows": 1, "extra_paddle_width": 1}
PAID = {"height": 3, "penalties": "0,2:-0.5", "rewards": "1,1:0.1"}
GAMES = {
    "simple_grid_penalty_then_goal": ("simple_grid", PAID, "lurrurdldr"),
    "simple_grid_decoy": ("simple_grid/4x4-decoy", {}, "rrddd"),
    "frozen_lake_goal": ("frozen_lake/4x4", {}, "ddrrdr"),
    "frozen_lake_hole": ("frozen_lake/4x4", {}, "urrdl"),
    "freeway_across_after_a_hit": (
        "freeway",
        {"num_cars": 4, "lane_length": 5, "car_speeds": "1,2,3,2"},
        "usuuuduuusuuuuuuu",
    ),
    "freeway_slow_player_pushed_back": (
        "freeway",
        {"num_cars": 3, "lane_length": 5, "player_speed": 2, "car_speeds": 2, "restart_on_hit": False},
        "uuuuuuuuuuuuuuuuuu",
    ),
    "breakout_bounces_and_loses": (
        "breakout",
        {"height": 8, "columns": 5, "brick_rows": 2},
        "srrlllssssrrrrsslllssrrss" + "s" * 20,
    ),
    "breakout_wall_comes_back": ("breakout", WALL, "s" * 24),
    "breakout_cleared_without_respawn": ("breakout", {**WALL, "respawn": False}, "s" * 24),
    "sliding_tiles_solved": ("sliding_tiles", {"rows": 2, "columns": 3, "start": "1,0,3,4,2,5"}, "udr"),
    "sliding_tiles_against_the_edge": ("sliding_tiles/3x3", {}, "drulluur"),
    "pocket_cube_solved": ("pocket_cube", {"scramble": "F' U2 R"}, ["R'", "U2", "F"]),
    "pocket_cube_commutator": (
        "pocket_cube",
        {"metric": "quarter", "scramble": "R U R' U' R U R' U' R U R' U'"},
        ["R", "U", "R'", "U'"] * 3,
    ),
    "mini_grid_door_key": ("mini_grid/door-key-5x5", {}, "rfpffrftttfdfpfrff"),
    "mini_grid_box_opened_and_ball_taken": (
        "mini_grid",
        {"level": "##########/##>>BRAB##/##########", "target": "AB"},
        "pdtfp",
    ),
    "mini_grid_empty_goal_pays_at_every_step": (
        "mini_grid_empty",
        {"size": 3},
        ["turn right", "turn right", *["forward"] * 3, "turn right", "forward", "turn left", "forward"],
    ),
    "mini_grid_rooms_through_a_door": (
        "mini_grid_rooms",
        {"room_size": 2, "seed": 1},
        [*(["turn left"] + ["forward"] * 2) * 2, "turn left", "forward", *(["turn right"] + ["forward"] * 3) * 2],
    ),
    "mini_grid_lava": ("mini_grid/lava-gap-s5", {"seed": 1}, "rflfrf"),
    "sokoban_corner_solved": ("sokoban/corner", {}, "rdldr"),
    "sokoban_off_and_on_a_target": ("sokoban", {"level": "#######/#-@*--#/#---$-#/#---.-#/#######"}, "rddrruuld"),
    "cliff_walking_slips_over_the_edge": ("cliff_walking/4x12-slippery", {"width": 5}, "u1r1r1r2r1r1d1"),
    "taxi_in_the_rain_with_a_fickle_passenger": (
        "taxi/5x5-rainy-fickle",
        {"size": 3, "landmarks": "0,0; 2,2; 0,2", "walls": "0,0"},
        "p0d3r0u2s0u0s0",
    ),
    "blackjack_hits_and_sticks": ("blackjack", {}, "h1h3s3"),
    "game_2048_to_16_on_turned_boards": ("game_2048/2x2-to-32", {"target": 16}, "u1u1u3u0u0"),
    "game_2048_stuck": ("game_2048/2x2", {"canonical": False}, "u0u2r0d1u0l1r0u0u0"),
    "blackjack_busts": ("blackjack/natural", {}, "h9h9h9"),
    "corner_grid_stays_in_two_corners": ("corner_grid/8x8-random", {"size": 3}, "u0r0s0u5l0l2s0s1"),
    "deep_sea_loses_the_treasure": ("deep_sea", {"size": 4, "stochastic": True, "mapping_seed": 42}, "f0f1s0f0"),
    "endless_sea_dives_twice": ("endless_sea", {"size": 3}, "s0s0s0f0s0f0"),
    "river_swim_against_the_current": ("river_swim", {"length": 4}, "r2r1r2r0r2r1l0l0l1r1"),
    "catch_missed": ("catch", {"rows": 5, "columns": 4}, "lllr"),
    "memory_chain_of_three_bits": ("memory_chain", {"memory_length": 2, "num_bits": 3}, ["one", "one", "zero"]),
    "umbrella_chain_without_need": ("umbrella_chain", {"chain_length": 3}, ["take", "leave", "leave"]),
    "discounting_chain_with_a_bonus": (
        "discounting_chain",
        {"delays": "1,2,4", "mapping_seed": 1},
        ["wait for 2", *["wait for 4"] * 3],
    ),
    "delayed_choice_of_a_noisy_cue": (
        "delayed_choice/noisy",
        {"length": 3, "lag": 1, "num_actions": 3, "cues": 1, "irrelevant_bits": 2},
        ["action 0", "action 2", "action 0"],
    ),
}


def file_of(game: str) -> Path:
    return FOLDER / f"{game}.txt"


def played(game: str) -> str:
    """The game as text: environment, then state, drawing, action and reward of every step up to its end."""
    name, parameters, letters = GAMES[game]
    env = pharos.make(name, **parameters)
    lines = [str(env), ""]
    state, total = tuple(env.initial_states()[0][0]), 0.0
    lines += [f"state {state}", text_drawing(env, state), ""]
    moves = re.findall("([a-z])([0-9]?)", letters) if isinstance(letters, str) else [(name, "") for name in letters]
    for step, (begin, digit) in enumerate(moves, start=1):
        action = next(i for i, action in enumerate(env.actions) if action.startswith(begin))
        following = env.next_state(state, action, int(digit or 0))
        reward = env.reward_of(state, action, following, int(digit or 0))
        state, total = following, total + reward
        lines += [f"{step}. {env.actions[action]}, reward {reward:g}", f"state {state}", text_drawing(env, state), ""]
        if env.is_terminal(state):
            lines.append("the end")
            break
    return "\n".join([*lines, f"return {total:g}", ""])


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for game in GAMES:
        file_of(game).write_text(played(game))
