"""What the table of an Atari game costs: frames and states a second beside plain stepping, and bytes a state.

    python benchmarks/consoles.py [--games freeway pong breakout] [--horizon 8] [--frame-skip 30]

Processor time of one process; plain stepping holds random actions for as many frames, and resets where the game ends,
in the same run. Bytes are those of the folder that `importers.save` writes.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from pharos import importers
from pharos.importers.consoles import AtariGame


def plain_frames_a_second(game: str, frame_skip: int, horizon: int, steps: int) -> float:
    """Frames of ale-py a processor second in random episodes, without saving, restoring or looking; resets not counted.

    As in a layered search, most steps are the last ones of an episode.
    """
    console = AtariGame(game, frame_skip)
    rng, seconds, frames = np.random.default_rng(0), 0.0, 0
    while frames < steps * frame_skip:
        console.start()
        for depth, action in enumerate(rng.integers(len(console.actions), size=horizon)):
            move, began = console.legal[action], time.process_time()
            for _ in range(frame_skip):
                console.ale.act(move)
            if depth >= horizon // 2:
                seconds, frames = seconds + time.process_time() - began, frames + frame_skip
    return frames / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--games", nargs="+", default=["freeway", "pong", "breakout"])
    parser.add_argument("--horizon", type=int, default=8)
    parser.add_argument("--frame-skip", type=int, default=30)
    options = parser.parse_args()
    importers.atari(options.games[0], horizon=2)  # loads and compiles
    names = "game, states, merged to, screens, frames/s, of plain, states/s, table B/state, screens B/state, raw"
    print("|", names.replace(", ", " | "), "|")
    print("|---" * 10 + "|")
    for game in options.games:
        began = time.process_time()
        mdp, recording = importers.atari(game, horizon=options.horizon, frame_skip=options.frame_skip)
        seconds = time.process_time() - began
        frames = recording.num_steps * options.frame_skip
        plain = plain_frames_a_second(game, options.frame_skip, options.horizon, min(recording.num_steps, 500))
        with tempfile.TemporaryDirectory() as place:
            folder = importers.save_recording(mdp, recording, Path(place) / "mdp")
            sizes = {file.name: file.stat().st_size for file in folder.iterdir()}
        screens = sizes["observations.bin"] + sizes["observation_index.npy"]
        table = sizes["next_states.npy"] + sizes["rewards.npy"]
        raw = int(np.prod(recording.observations.shape, dtype=np.int64))
        print(
            f"| {game} | {recording.num_raw_states:,} | {mdp.num_states:,} | {recording.observations.num_distinct:,} | "
            f"{frames / seconds:,.0f} | {frames / seconds / plain:.2f} | {recording.num_raw_states / seconds:,.0f} | "
            f"{table / mdp.num_states:.0f} | {screens / mdp.num_states:.0f} | {raw / screens:,.0f}x |"
        )


if __name__ == "__main__":
    main()
