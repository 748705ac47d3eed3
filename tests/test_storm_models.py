"""PRISM, JANI and DRN models through Storm: published numbers of states and values. Needs the extra `storm`."""

import json

import pytest
from typer.testing import CliRunner

import pharos
from pharos import exporters, importers
from pharos.cli import app
from pharos.errors import FileFormatError, MissingExtra, ParameterError, UnknownName

try:
    import stormpy.examples.files as models
except ImportError:
    models = None

needs_storm = pytest.mark.skipif(models is None, reason="stormpy is not installed")


def run(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.mark.skipif(models is not None, reason="stormpy is installed")
def test_without_storm_the_extra_is_named(tmp_path):
    with pytest.raises(MissingExtra, match=r"pip install 'pharos-rl\[storm\]'"):
        importers.storm(tmp_path / "model.nm")
    done = run("import", "prism", tmp_path / "model.nm", "--out", tmp_path / "out")
    assert done.exit_code == 1 and len(done.stderr.strip().splitlines()) == 1


@needs_storm
def test_models_have_their_published_numbers_of_states():
    """The dice of Knuth and Yao, the shared coin of two processes (K = 2), bounded retransmission (N = 16, MAX = 2)."""
    for file, states in (
        (models.prism_dtmc_die, 13),
        (models.jani_dtmc_die, 13),
        (models.prism_mdp_coin_2_2, 272),
        (models.prism_dtmc_brp, 677),
    ):
        assert importers.storm(file, target="deadlock").num_states == states
    die = importers.storm(models.prism_dtmc_die, target="six", horizon=100)
    assert pharos.value_iteration(die, 1e-10).value_at_start == pytest.approx(1 / 6, abs=1e-9)


@needs_storm
def test_constants_rewards_and_states_with_fewer_choices(tmp_path):
    text = """mdp
const int N;
module walk
  s : [0..N] init 0;
  [] s<N -> 0.5:(s'=s+1) + 0.5:(s'=s);
  [] s=0 -> (s'=N);
endmodule
rewards "steps"
  s<N : 1;
  [] s=0 : 0.25;
endrewards
label "there" = s=N;
"""
    (tmp_path / "walk.nm").write_text(text)
    mdp = importers.storm(tmp_path / "walk.nm", constants="N=3", reward="steps", target="there", horizon=500)
    assert (mdp.num_states, mdp.num_actions) == (4, 2)
    assert sorted(mdp.rewards.tolist()) == [[0.0, 0.0], [1.0, 1.0], [1.0, 1.0], [1.25, 1.25]]
    assert pharos.value_iteration(mdp, 1e-9).value_at_start == pytest.approx(6.5, abs=1e-8)
    assert pharos.solvers.worst_value(mdp, 1e-9).value_at_start == pytest.approx(1.25, abs=1e-8)


@needs_storm
def test_the_shared_coin_takes_48_to_75_steps():
    mdp = importers.storm(models.prism_mdp_coin_2_2, reward="steps", target="finished", horizon=4000)
    assert pharos.value_iteration(mdp, 1e-8).value_at_start == pytest.approx(75, abs=2e-6)
    assert pharos.solvers.worst_value(mdp, 1e-8).value_at_start == pytest.approx(48, abs=2e-6)


@needs_storm
def test_what_pharos_exports_comes_back(tmp_path):
    mdp = pharos.build(pharos.make("simple_grid")).mdp(gamma=0.9)
    back = importers.storm(exporters.drn(mdp, tmp_path / "grid.drn"), reward="reward", target="terminal", horizon=1000)
    expected = pharos.value_iteration(mdp, 1e-9).value_at_start
    assert pharos.value_iteration(back, 1e-9).value_at_start == pytest.approx(expected, abs=1e-8)


@needs_storm
def test_what_cannot_be_imported_is_one_line(tmp_path):
    with pytest.raises(FileFormatError, match="undefined constants"):
        importers.storm(models.prism_mdp_firewire, target="done")
    with pytest.raises(UnknownName, match="label"):
        importers.storm(models.prism_dtmc_die, target="dome")
    with pytest.raises(ParameterError, match="nothing says what is paid"):
        importers.storm(models.jani_dtmc_die, constants="")
    with pytest.raises(FileFormatError, match="expected an MDP or a DTMC"):
        importers.storm(models.prism_pomdp_maze, target="goal")
    with pytest.raises(ParameterError, match="no such file"):
        importers.storm(tmp_path / "nothing.nm")
    words = (models.prism_mdp_coin_2_2, "--target", "finished", "--reward", "steps", "--out", tmp_path / "coin")
    assert json.loads(run("import", "prism", *words, "--json").stdout)["num_states"] == 272
    assert pharos.make(str(tmp_path / "coin")).has_chance
