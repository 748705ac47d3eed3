"""Frames per second of simple and complex images, in batches of 1024 random states.

python benchmarks/rendering.py [--seconds S]
"""

import argparse
import time

import numpy as np

import pharos


def frames_per_second(env, name, seconds):
    """Batches of the same 1024 random states."""
    components = env.components
    states = components.low + np.random.default_rng(0).integers(0, components.size, (1024, len(components)))
    observation = pharos.observe(env, name)
    observation(states)
    frames, began = 0, time.perf_counter()
    while time.perf_counter() - began < seconds:
        observation(states)
        frames += len(states)
    return frames / (time.perf_counter() - began)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=1.0, help="measured for each row")
    seconds = parser.parse_args().seconds
    for name in ("simple_grid/8x8-decoy", "frozen_lake/8x8", "freeway/16x7-speed1", "breakout/12x10x1"):
        env = pharos.make(name)
        rates = {image: frames_per_second(env, image, seconds) for image in ("simple_image", "complex_image")}
        print(f"{name:24}", *(f"{image} {rate / 1e3:10.1f} k frames/s" for image, rate in rates.items()))


if __name__ == "__main__":
    main()
