"""The file of an agent's results in a benchmark."""

import json

import numpy as np
import pytest

from pharos.benchmark.results import AgentResults, baselines
from pharos.errors import FileFormatError, ParameterError, ResultCorrupted
from refusals import refusal


def made(**changes):
    values = {
        "agent": "mine",
        "suite": "v1",
        "digest": "ab" * 32,
        "seeds": (0, 3),
        "curves": {"sea": np.array([[1.0, 0.1], [np.pi, -0.2]]), "catch": np.zeros((2, 2))},
        "record": {"form": "generator", "hyperparameters": {"lr": 1e-3}},
    }
    return AgentResults(**{**values, **changes})


def test_what_is_written_is_read_back_to_the_bit(tmp_path):
    file = tmp_path / "results.safetensors"
    made().write(file)
    for source in (file, tmp_path, str(tmp_path)):
        read = AgentResults.read(source)
        assert (read.agent, read.suite, read.digest, read.seeds) == ("mine", "v1", "ab" * 32, (0, 3))
        assert read.record == made().record and list(read.curves) == ["catch", "sea"]
        assert all((read.curves[name] == curve).all() for name, curve in made().curves.items())
        assert read.curves["sea"].dtype == np.float64


def test_the_same_results_give_the_same_bytes(tmp_path):
    made().write(tmp_path / "a")
    made(curves=dict(reversed(list(made().curves.items())))).write(tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_every_changed_byte_is_found(tmp_path):
    file = tmp_path / "results.safetensors"
    made().write(file)
    whole = file.read_bytes()
    for place in range(0, len(whole), 7):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises((ResultCorrupted, FileFormatError)) as error:
            AgentResults.read(file)
        assert str(file) in str(error.value) and "\n" not in str(error.value)
    file.write_bytes(whole[:-8])
    with pytest.raises(ResultCorrupted):
        AgentResults.read(file)


def test_a_file_that_promises_more_than_it_has_is_refused(tmp_path):
    file = tmp_path / "huge.safetensors"
    header = json.dumps({"a": {"dtype": "F64", "shape": [1 << 40], "data_offsets": [0, 1 << 43]}}).encode()
    file.write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(ResultCorrupted):
        AgentResults.read(file)
    file.write_bytes((1 << 50).to_bytes(8, "little") + header)
    assert "header would have" in refusal(FileFormatError, AgentResults.read, file)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seeds": ()}, "at least one"),
        ({"seeds": (1, 1)}, "each once"),
        ({"curves": {"sea": np.zeros((3, 2))}}, "shape (3, 2); expected (2 seeds"),
        ({"curves": {"sea": np.zeros((2, 2)), "catch": np.zeros((2, 3))}}, "as many evaluations"),
        ({"curves": {"sea": np.array([[1.0], [np.nan]])}}, "sea hold NaN"),
    ],
)
def test_results_that_cannot_be_are_refused(changes, said):
    assert said in refusal(ParameterError, made, **changes)


def test_results_that_are_nowhere(tmp_path):
    for source in (tmp_path, tmp_path / "none", "no_such_baseline"):
        with pytest.raises(ParameterError):
            AgentResults.read(source)
    run = tmp_path / "interrupted" / "runs" / "sea" / "seed-0"
    run.mkdir(parents=True)
    (run / "curve.csv").touch()
    assert "1 runs have finished, some are missing: run the same command again" in refusal(
        ParameterError, AgentResults.read, tmp_path / "interrupted"
    )
    assert baselines("no such suite") == ()
