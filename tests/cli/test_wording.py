"""What the library says of numbers reads well at one, too."""

import pytest

from pharos.mdp import TabularMDP
from pharos.study.status import Status
from pharos.system.wording import many


@pytest.mark.parametrize(
    ("count", "said"), [(0, "0 runs"), (1, "1 run"), (2, "2 runs"), (1234, "1,234 runs"), (10**6, "1,000,000 runs")]
)
def test_one_is_singular(count, said):
    assert many(count, "run") == said


def test_irregular_nouns_are_given():
    assert (many(1, "class", "classes"), many(3, "class", "classes")) == ("1 class", "3 classes")


def test_one_run_one_state_and_one_action_are_singular():
    assert "1 state, 1 action," in repr(TabularMDP.from_arrays([[0]], [[1.0]]))
    assert "of 1 run finished" in str(Status("one", "studies/one", 1, 0, 0, 0, {}))
