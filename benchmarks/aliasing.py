"""Which states share an image, without and with motion, and how long it takes to find out.

python benchmarks/aliasing.py [--images simple_image,complex_image] [--plain] [NAME ...]

NAME is a class, a named instance, or nothing for all. Prints a row of a Markdown table for each.
"""

import argparse
import time

import pharos
from pharos.observations import aliasing, observe


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="all when not given")
    parser.add_argument("--images", default="simple_image")
    parser.add_argument("--plain", action="store_true", help="without motion, too")
    parser.add_argument("--max-states", type=int, help="leave larger instances out")
    given = parser.parse_args()
    everything = pharos.list_environments()
    names = [name for name in everything if not given.names or {name, name.split("/")[0]} & set(given.names)]
    for name in names:
        env = pharos.make(name)
        if not env.instances or "/" in name:
            count(name, env, given)


def count(name, env, given):
    """Print the rows of one instance."""
    try:
        space = pharos.build(env, max_states=given.max_states, progress=False)
    except pharos.errors.StateSpaceTooLarge:
        print(f"| `{name}` | more than {given.max_states:,} |", flush=True)
        return
    for image in given.images.split(","):
        for options in ({}, {"motion": True}) if given.plain else ({"motion": True},):
            seen = observe(env, image, **options)
            began = time.perf_counter()
            counts = aliasing(space, seen)
            words = f"{counts.num_states:,} | {counts.num_observations:,} | {100 * counts.share:.1f} %"
            print(f"| `{name}` | {image} {options or ''} | {words} | {time.perf_counter() - began:.1f} s |", flush=True)


if __name__ == "__main__":
    main()
