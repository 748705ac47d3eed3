"""A runner of batches that learns nothing: what `fake_training` writes for each run, and a line for each batch.

The file PHAROS_FAKE_BATCHES gets the size of each batch; PHAROS_FAKE_PARENTS, if given, the process that started this
one. PHAROS_FAKE_MOST runs fit into memory: more, and the process is killed. PHAROS_FAKE_SECONDS is how long a run
takes, PHAROS_FAKE_FAIL a seed that fails; the batch has a checkpoint while it is trained.
"""

import json
import os
import signal

import fake_training


def train(configs, folders, checkpoints):
    with open(os.environ["PHAROS_FAKE_BATCHES"], "a") as file:
        file.write(f"{len(configs)}\n")
    if "PHAROS_FAKE_PARENTS" in os.environ:
        with open(os.environ["PHAROS_FAKE_PARENTS"], "a") as file:
            file.write(f"{os.getppid()}\n")
    ids = [fake_training.run_id(config) for config in configs]
    place = checkpoints / ids[0]  # batches that go on at the same time have folders of their own
    place.mkdir(parents=True, exist_ok=True)
    (place / "batch.json").write_text(json.dumps({"ids": ids}))
    if len(configs) > int(os.environ.get("PHAROS_FAKE_MOST", 1000)):
        os.kill(os.getpid(), signal.SIGKILL)
    errors = []
    for config, folder in zip(configs, folders, strict=True):
        fails = str(config["seed"]) == os.environ.get("PHAROS_FAKE_FAIL")
        errors.append("this seed fails on purpose" if fails else None)
        if not fails:
            fake_training.train(config, folder)
    (place / "batch.json").unlink()
    place.rmdir()
    return errors
