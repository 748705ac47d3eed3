"""What runs on other devices than the processor, here on the processor by another name, and Triton's interpreter."""

import contextlib
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from batched_runs import difference, learned, runs_of
from pharos.agents.batched import arithmetic, group_key, inputs, make_batch, networks
from pharos.agents.batched.arithmetic import CudaGraph, PinnedBuffer
from pharos.environments import make
from pharos.errors import ParameterError
from pharos.training import Task

ELSEWHERE = "cpu:0"
DQN = {"learning_rate": 0.01, "buffer_size": 60, "learning_starts": 20, "batch_size": 8, "train_freq": 4,
       "target_update_interval": 10, "net_arch": [12]}  # fmt: skip
PPO = {"n_envs": 2, "n_steps": 8, "batch_size": 12, "n_epochs": 2, "net_arch": [7]}
AGENTS = {"dqn": DQN, "ppo": PPO}


def grids(agent, observation, sizes, number=2):
    """Runs on grids of these sizes, one after another."""
    tasks = [Task.of(make("simple_grid", height=size, width=size), observation=observation) for size in sizes]
    return [
        run
        for task, size in zip(tasks, sizes, strict=True)
        for run in runs_of(task, AGENTS[agent], number, first_key=2**40 + size)
    ]


@pytest.mark.long
@pytest.mark.parametrize("observation", ["one_hot", "simple_image"])
@pytest.mark.parametrize("agent", AGENTS)
def test_runs_that_see_more_or_less_share_a_lane_and_learn_what_they_learn_alone(agent, observation):
    runs = grids(agent, observation, (4, 6))
    batch = learned(agent, runs, device=ELSEWHERE)
    (lane,) = batch.lanes
    assert len({view.shape for view in lane.inputs.table.views}) == 2
    for first in (0, 2):
        alone = learned(agent, runs[first : first + 2])
        for i in (0, 1):
            mine, theirs = batch.parameters(first + i), alone.parameters(i)
            assert {name: each.shape for name, each in mine.items()} == {name: x.shape for name, x in theirs.items()}
            assert difference(mine, theirs) <= 1e-4
            assert (batch.episodes[first + i], batch.returns[first + i]) == (alone.episodes[i], alone.returns[i])
            seen = runs[first].observe.at(np.arange(16))
            answers = (each.action_probabilities(seen) for each in (batch.policy(first + i), alone.policy(i)))
            assert np.abs(np.subtract(*answers)).max() <= 1e-4


@pytest.mark.long
def test_what_a_run_has_not_stays_zero():
    """Weights of inputs that only the others of a lane have."""
    batch = learned("dqn", grids("dqn", "simple_image", (4, 6)), device=ELSEWHERE)
    (lane,) = batch.lanes
    weights = lane.networks.values["q_net.features_extractor.layers.1.weight"]
    assert weights.shape[1] == 36 * 16
    assert not weights[:2, 16 * 16 :].any() and weights[2:4, 16 * 16 :].any()


def test_shapes_share_a_lane_elsewhere_and_not_on_the_processor():
    near, far = (grids("dqn", "simple_image", (4, size), 1) for size in (6, 9))
    assert len({group_key("dqn", run, "cuda") for run in near}) == 1
    assert len({group_key("dqn", run, "cuda") for run in far}) == len({group_key("dqn", run) for run in near}) == 2
    with pytest.raises(ParameterError, match="2 groups"):
        make_batch("dqn", near)


@pytest.mark.parametrize("agent", AGENTS)
def test_a_batch_elsewhere_goes_on_from_its_state_bit_for_bit(agent):
    runs = grids(agent, "one_hot", (4, 5))
    whole, first = (learned(agent, runs, points, device=ELSEWHERE) for points in ((60, 120), (60,)))
    second = make_batch(agent, runs, device=ELSEWHERE)
    second.restore(first.state())
    second.learn([120], lambda point: None)
    for i in range(len(runs)):
        mine, theirs = whole.parameters(i), second.parameters(i)
        assert all(mine[name].tobytes() == theirs[name].tobytes() for name in mine)


def test_convolutions_side_by_side_are_those_run_by_run(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    parameters = networks.Parameters()
    layer = networks.ConvolutionLayer(parameters, "c", (2, 12, 12), 5, 4, 2, 1 / 255)
    rows = torch.randn(3, parameters.length, generator=generator)
    values, x = parameters.views(rows), 255 * torch.rand(3, 4, layer.inputs, generator=generator)
    dy, answers = torch.randn(3, 4, layer.outputs, generator=generator), []
    for one_by_one in (True, False):
        monkeypatch.setattr(networks, "is_one_by_one", lambda x, answer=one_by_one: answer)
        gradients = torch.zeros_like(rows)
        y = layer.forward(values, x).clone()
        dx = layer.backward(values, parameters.views(gradients), x, dy.clone(), onward=True)
        answers.append((y, dx.clone(), gradients))
    for one, other in zip(*answers, strict=True):
        assert (one - other).abs().max() <= 1e-4 * one.abs().max()


@pytest.mark.parametrize("kind", ["convolution", "pictures"])
def test_idle_runs_of_a_narrow_lane_have_no_convolutions_and_the_others_the_same(kind):
    """On the processor two runs of four are computed to the bit as if all four were, the rest stays 0."""
    generator = torch.Generator().manual_seed(1)
    answers = []
    for number in (None, 2):
        parameters = networks.Parameters()
        if kind == "pictures":
            layer = networks.PictureLayers(parameters, "c", (1, 5, 4))
        else:
            layer = networks.ConvolutionLayer(parameters, "c", (2, 12, 12), 5, 4, 2, 1 / 255)
        layer.number = number
        if number is None:
            rows = torch.randn(4, parameters.length, generator=generator)
            pixels = networks.aligned_zeros(4, 3, layer.inputs)
            pixels.copy_(255 * (torch.rand(pixels.shape, generator=generator) > 0.5))
            dy = torch.randn(4, 3, layer.outputs, generator=generator)
        gradients = torch.zeros_like(rows)
        y = layer.forward(parameters.views(rows), pixels).clone()
        layer.backward(parameters.views(rows), parameters.views(gradients), pixels, dy.clone(), onward=False)
        answers.append((y, gradients))
    for whole, part in zip(*answers, strict=True):
        assert whole[2:].any() and torch.equal(whole[:2], part[:2])
        assert not part[2:].any()


def test_mirrors_are_one_array_on_the_processor_and_two_elsewhere():
    here, there = (PinnedBuffer((3,), torch.float32, device) for device in ("cpu", ELSEWHERE))
    for mirror, alike in ((here, True), (there, False)):
        mirror.array[:] = (1, 2, 3)
        assert mirror.tensor.tolist() == ([1, 2, 3] if alike else [0, 0, 0])
        mirror.send()
        mirror.tensor.mul_(2)
        assert mirror.array.tolist() == ([2, 4, 6] if alike else [1, 2, 3])
        mirror.fetch()
        assert mirror.array.tolist() == [2, 4, 6]


def test_a_program_runs_each_time_it_is_called():
    calls = []
    program = CudaGraph(lambda: calls.append(0), ELSEWHERE)
    for _ in range(3):
        program()
    assert len(calls) == 3


@pytest.fixture
def recorder(monkeypatch):
    """A GPU that writes down what it is told."""
    told = []

    class Graph:
        def replay(self):
            told.append("replay")

    @contextlib.contextmanager
    def recording(graph, **options):
        told.append("record")
        yield

    monkeypatch.setattr(arithmetic, "is_gpu", lambda device: True)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", recording)
    return told


def test_a_program_is_recorded_by_its_second_call_and_then_replayed(recorder):
    program = CudaGraph(lambda: recorder.append("run"), "cuda")
    for _ in range(3):
        program()
    assert recorder == ["run", "record", "run", "replay", "replay"]


def test_a_program_that_cannot_be_recorded_is_run_as_it_is(recorder):
    def operations():
        recorder.append("run")
        if recorder[-2:] == ["record", "run"]:
            raise RuntimeError("operation not permitted when stream is capturing")

    program = CudaGraph(operations, "cuda")
    program()
    with pytest.warns(UserWarning, match="does not record the updates, which are slower so: operation not permitted"):
        program()
    program()
    assert recorder == ["run", "record", "run", "run", "run"]


def test_observations_that_do_not_fit_on_the_device_are_counted(monkeypatch):
    monkeypatch.setattr(inputs, "is_gpu", lambda device: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (1 << 12, 1 << 30))
    with pytest.raises(MemoryError, match="of 52 states take 0 MiB on cpu:0, more than 50%"):
        make_batch("dqn", grids("dqn", "simple_image", (4, 6), 1), device=ELSEWHERE)


CODE = """
import numpy as np, torch
from pharos.agents.batched.arithmetic import TensorArithmetic
from pharos.agents.batched.fused import adam
torch.manual_seed(0)
states = [[torch.randn(3, 1500), torch.randn(3, 1500), torch.randn(3, 1500), torch.rand(3, 1500)]]
states.append([each.clone() for each in states[0]])
for fused, state in zip((adam, None), states):
    arithmetic = TensorArithmetic("cpu:0", 3)
    arithmetic._fused = fused
    counts = np.array([0, 5, 7])
    for is_active in ([True, True, False], [False, True, False]):
        arithmetic.plan(counts, np.array(is_active), np.full(3, 0.01), np.array([0.5, 1e9, 1.0]), 1e-8)
        arithmetic.adam(state)
for one, other in zip(*states):
    assert (one - other).abs().max() <= 1e-6, (one - other).abs().max()
assert not torch.equal(states[0][0][0], states[0][0][1])
"""


def test_fused_adam_computes_what_tensor_operations_do():
    pytest.importorskip("triton")  # torch for CUDA brings it along
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
