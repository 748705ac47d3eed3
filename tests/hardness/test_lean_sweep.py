"""Diameters by sweeps over the table, in two bytes a state: against all pairs, and where two bytes are too few."""

import contextlib
import importlib

import numpy as np
import pytest
from hypothesis import strategies as st
from test_diameter import deterministic_mdps

from naive.hardness import distances
from pharos import TabularMDP, hardness
from pharos.errors import FileFormatError
from pharos.hardness.sum_sweep import Graph
from pharos.system import memory
from strategies import examples

sweeps = importlib.import_module("pharos.hardness.diameter")
pytestmark = pytest.mark.long


@pytest.fixture
def no_memory(monkeypatch):
    monkeypatch.setattr(sweeps, "available_memory", lambda: 0)


@examples(150, deterministic_mdps(), st.booleans())
def test_the_diameter_is_the_largest_distance_between_any_two_states(mdp, restart):
    d = distances(mdp, restart=restart)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "available_memory", lambda: 0)
        found = hardness.diameter(mdp, restart=restart)
        eccentricity = hardness.start_eccentricity(mdp, restart=restart)
    assert "sweeps over the table" in found.method
    assert found.exact and found.lower == found.upper == d.max()
    assert eccentricity == d[mdp.initial].max()
    if np.isinf(d).any():
        assert 1 <= found.unreachable_pairs <= np.isinf(d).sum() and not found.counted


@examples(100, deterministic_mdps(), st.booleans(), st.sampled_from([np.int16, np.int32]), st.booleans())
def test_sweeps_give_the_distances_of_searches(mdp, restart, dtype, is_mapped):
    plain = Graph.of(mdp, restart)
    graph = sweeps.LeanGraph(plain, dtype)
    if is_mapped:
        graph.next_states = graph.next_states.view(np.memmap)
    d = distances(mdp, restart=restart)
    expected = np.where(np.isinf(d), graph.far, d).astype(dtype)
    found = np.empty(graph.num_nodes, dtype)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "RANGE_ROWS", 5)
        for node in range(graph.num_nodes):
            forward = graph.search_forward(node, found)
            assert (found == expected[node]).all()
            inside = d[node][np.isfinite(d[node])]
            assert forward == (len(inside), inside.max(), inside.sum())
            graph.search_backward(node, found)
            assert (found == expected[:, node]).all()


@pytest.mark.parametrize("size", (32_766, 32_767, 32_768, 40_000))
def test_distances_that_two_bytes_cannot_hold_take_four(size, no_memory, monkeypatch):
    state = np.arange(size)
    table = np.stack([(state + 1) % size, np.zeros_like(state)], axis=1)  # one step on, or back to the start
    mdp = TabularMDP.from_arrays(table, np.zeros(table.shape))
    widths, lean = [], sweeps.LeanGraph

    def made(graph, dtype):
        widths.append(dtype)
        return lean(graph, dtype)

    monkeypatch.setattr(sweeps, "LeanGraph", made)
    found = hardness.diameter(mdp)
    assert found.exact and found.upper == size - 1
    assert (widths == [np.int16]) == (size < 2**15 - 1)


def test_an_interval_is_proven_within_the_budget(no_memory):
    rng = np.random.default_rng(0)
    order = rng.permutation(300)
    table = rng.integers(0, 300, (300, 2))
    table[order, 0] = np.roll(order, 1)
    mdp = TabularMDP.from_arrays(table, np.zeros((300, 2)))
    found = hardness.diameter(mdp, budget=hardness.Budget(searches=2))
    assert found.lower <= distances(mdp).max() <= found.upper


@examples(60, deterministic_mdps(), st.booleans(), st.integers(1, 3), st.integers(0, 2**32))
def test_a_diameter_goes_on_from_kept_bounds_wherever_it_was_stopped(tmp_path_factory, mdp, restart, searches, seed):
    d = distances(mdp, restart=restart)
    folder = tmp_path_factory.mktemp("bounds")
    rng, raised = np.random.default_rng(seed), sweeps.SumSweep._search_out

    def stopped(self, v):  # in the middle of an update, of which any entries may be there
        before = self.in_lower.copy()
        raised(self, v)
        is_lost = rng.random(len(before)) < 0.5
        self.in_lower[is_lost] = before[is_lost]
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "available_memory", lambda: 0)
        if rng.random() < 0.5:
            patch.setattr(sweeps.SumSweep, "_search_out", stopped)
        with contextlib.suppress(KeyboardInterrupt):
            part = hardness.diameter(mdp, restart=restart, budget=hardness.Budget(searches=searches), bounds=folder)
            assert part.lower <= d.max() <= part.upper
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "available_memory", lambda: 0)
        whole = hardness.diameter(mdp, restart=restart, bounds=folder)
    assert whole.exact and whole.upper == d.max() and [*folder.iterdir()] == []


def test_a_diameter_is_found_one_search_a_call(no_memory, tmp_path):
    rng = np.random.default_rng(0)
    table = rng.integers(0, 300, (300, 2))
    table[:, 0] = np.roll(np.arange(300), -1)
    mdp = TabularMDP.from_arrays(table, np.zeros((300, 2)))
    budget, calls = hardness.Budget(searches=1), 0  # spent by the first search; without bounds kept, for ever
    found = hardness.diameter(mdp, budget=budget, bounds=tmp_path)
    assert not found.exact and {path.name for path in tmp_path.iterdir()} == {"bounds.npy", "bounds.json"}
    while not found.exact:
        lower, upper, calls = found.lower, found.upper, calls + 1
        found = hardness.diameter(mdp, budget=budget, bounds=tmp_path)
        assert lower <= found.lower <= found.upper <= upper
        assert calls < 300
    assert found.upper == hardness.diameter(mdp).upper


def test_bounds_of_another_mdp_are_refused_in_one_line(no_memory, tmp_path):
    table = np.stack([np.roll(np.arange(300), -1), np.random.default_rng(1).integers(0, 300, 300)], axis=1)
    mdp = TabularMDP.from_arrays(table, np.zeros((300, 2)))
    hardness.diameter(mdp, budget=hardness.Budget(searches=2), bounds=tmp_path)
    other = TabularMDP.from_arrays(table[:, ::-1].copy(), np.zeros((300, 2)))
    with pytest.raises(FileFormatError, match="is of another graph"):
        hardness.diameter(other, bounds=tmp_path)


@pytest.mark.parametrize("size", (32_766, 40_000))
def test_kept_bounds_are_of_two_bytes_or_four(size, no_memory, tmp_path):
    state = np.arange(size)
    table = np.stack([(state + 1) % size, np.zeros_like(state)], axis=1)
    mdp = TabularMDP.from_arrays(table, np.zeros(table.shape))
    part = hardness.diameter(mdp, bounds=tmp_path, budget=hardness.Budget(searches=1))
    assert part.lower <= size - 1 <= part.upper
    found = hardness.diameter(mdp, bounds=tmp_path)
    assert found.exact and found.upper == size - 1
